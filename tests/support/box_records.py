"""Records of a fictitious family "box", for tests of reports."""

from mortarbench.harness import Record, Verdict


def box_record(solver, case, seconds=0.01, repeat=0, **changes):
    """Return the record of a verified answer, with changes.

    case : n of the box, which has 100·(n + 1) dofs
    """
    form, tol = changes.get("form", "dual"), changes.get("tol", 1e-6)
    name = f"box/n={case}/{form}"
    defaults = dict(
        run_id=f"{solver}-{name}-{tol}-{repeat}", case=name, family="box",
        params={"n": case}, form=form, sizes={}, solver=solver, options={}, tol=tol,
        repeat=repeat, block=repeat, status=Verdict.VERIFIED, claimed="solved",
        iterations=7, total_seconds=seconds, primal=1e-9, dual=1e-9,
        complementarity=1e-9, gap=1e-9, quantities={"dofs": 100 * (case + 1)},
    )  # fmt: skip
    return Record(**(defaults | changes))
