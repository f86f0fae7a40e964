"""The command `solve`: one solver on one case, once."""

from __future__ import annotations

import json
import os
import sys
from argparse import Namespace
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from mortarbench.arguments import GRIDS, PICTURES, drawn_scale, tolerance, writable
from mortarbench.harness.distributed.mpi import ranks_asked
from mortarbench.harness.errors import InputError, say
from mortarbench.harness.names import assemble, is_shared, parse
from mortarbench.harness.registry import check_name
from mortarbench.harness.suite.solver_options import options_for
from mortarbench.registries import Registries, defer_parts_of_numpy

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mortarbench.answer import Answer
    from mortarbench.case import Case


def run(registries: Registries, options: Namespace) -> int:
    """Measure one solver on one case, in a worker; 0 if we can verify its answer."""
    tolerance(options.tol, "--tol")
    if options.plot is not None:
        writable(options.plot, PICTURES)
    if options.scale is not None:
        drawn_scale(options.scale, "--scale")
    if options.plot is None and options.scale is not None:
        raise InputError(
            f"--scale {options.scale:g} without --plot; expected a picture"
        )
    if options.vtu is not None:
        writable(options.vtu, GRIDS)
    ranks_asked(options.mpi, "--mpi")
    registries = registries.with_files(options.plugin)
    parsed = parse(options.case, registries.families)
    check_name(options.solver, registries.solvers)
    changed = options_for(options.solver, options.option, registries.solvers)

    defer_parts_of_numpy()
    from mortarbench.answer import answers_of
    from mortarbench.case import Case

    drawn = [o for o in ("plot", "vtu") if getattr(options, o) is not None]
    is_ours = registries.hold_own_code_only()
    forks = is_ours and not _loads_from_here()
    asked = answers_of(
        options.solver, registries, changed, forks=forks, ranks=options.mpi
    )
    with asked as solved:
        case = Case(id=parsed, registries=registries)
        if drawn or options.mpi == 1 or not (is_ours and is_shared(parsed)):
            _build(case, drawn)  # after the fork, which has no use for it
        answer = solved(case, options.tol)
    _print(answer, options)
    if drawn:
        _draw(answer, options)
    return 0 if answer.verdict.is_verified else 1


def _print(answer: Answer, options: Namespace) -> None:
    """Print the answer, and the error of the mesh where it was asked for."""
    from mortarbench.harness.record import Verdict

    record = answer.record
    mesh = answer.mesh_error() if options.mesh_error else None
    if options.json:
        data = answer.to_dict() | ({"discretisation": asdict(mesh)} if mesh else {})
        print(json.dumps(data, allow_nan=False))
    elif record.verdict is not Verdict.DECLINED:
        print(answer)
        if mesh is not None:
            print(f"error of the mesh, relative, in the energy norm: {mesh}")
        from mortarbench.text import convergence, legend

        if table := convergence(answer.history):
            print(f"\n{table}")
            if words := legend(answer.history):
                print(f"\n{words}")
    if record.verdict is Verdict.DECLINED:
        say(f"{record.solver} declines {record.case}: {record.message}{_hint(answer)}")


def _build(case: Case, drawn: Sequence[str]) -> None:
    """Build the case, and say what is odd about it; see that it can be drawn."""
    for remark in case.remarks:
        say(remark)
    if drawn and case.made.fields is None:
        wanted = ", ".join(f"--{o}" for o in drawn)
        raise InputError(f"{case.name} has no bodies to draw; leave out {wanted}")


def _hint(answer: Answer) -> str:
    """Name the dual of a case if its solver declines it for its inequality rows."""
    case = answer.case
    if case.form != "primal" or "dual" not in case.id.family.forms:
        return ""
    import numpy as np

    from mortarbench.harness.qp import no_rows
    from mortarbench.harness.registry import resolve
    from mortarbench.harness.verify.measure import reason_to_decline

    qp = case.made.qp
    n = qp.q.size
    without_rows = replace(qp, G=no_rows(n), h=qp.h[:0])
    like_dual = without_rows.with_bounds(0 * qp.q, 0 * qp.q + np.inf)
    solver = resolve(answer.spec, case.registries.solvers)
    try:
        dual = assemble(case.id.family, case.params, "dual").name
        declined = reason_to_decline(
            solver, like_dual
        )  # bounds in place of inequality rows
    except Exception:  # the family's or the solver's code: there is no hint then
        return ""
    return "" if declined else f"; dualise inequality rows first: solve {dual}"


def _loads_from_here() -> bool:
    """Whether a library may have come from the working directory, and only from there.

    ``python -m`` looks there first. Workers do not, so they must not be forks then.
    """
    first, *others = sys.path
    return first in ("", os.getcwd()) and first not in others


def _draw(answer: Answer, options: Namespace) -> None:
    """Write the pictures that were asked for."""
    if not answer.has_point:
        say(f"no picture: {answer.record.solver} returned no point")
        return
    if options.plot is not None:
        answer.plot(options.plot, scale=options.scale)
    if options.vtu is not None:
        answer.save_vtu(options.vtu)
