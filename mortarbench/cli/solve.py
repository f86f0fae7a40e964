"""The command `solve`: run one solver on one case."""

from __future__ import annotations

import json
from argparse import Namespace
from dataclasses import replace
from typing import TYPE_CHECKING

from mortarbench.arguments import (
    ARCHIVES,
    GRIDS,
    PICTURES,
    check_output_file,
    check_scale,
    tolerance,
)
from mortarbench.harness import checked
from mortarbench.harness.distributed.mpi import ranks_asked
from mortarbench.harness.errors import InputError, say
from mortarbench.harness.names import assemble, parse
from mortarbench.harness.registry import check_name
from mortarbench.harness.suite.solver_options import options_for
from mortarbench.registries import Registries, defer_parts_of_numpy

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mortarbench.answer import Answer
    from mortarbench.case import Case


def run(registries: Registries, options: Namespace) -> int:
    """Run one solver on one case in a worker; return 0 if its answer is verified."""
    tolerance(options.tol, "--tol")
    if options.plot is not None:
        check_output_file(options.plot, PICTURES)
    if options.scale is not None:
        check_scale(options.scale, "--scale")
    if options.plot is None and options.scale is not None:
        raise InputError(
            f"--scale {options.scale:g} without --plot; expected --plot FILE"
        )
    if options.vtu is not None:
        check_output_file(options.vtu, GRIDS)
    if options.out is not None:
        check_output_file(options.out, ARCHIVES)
    ranks_asked(options.mpi, "--mpi")
    checked.positive("--time-limit", options.time_limit)
    registries = registries.with_files(options.plugin)
    parsed = parse(options.case, registries.families)
    check_name(options.solver, registries.solvers)
    changed = options_for(options.solver, options.option, registries.solvers)

    defer_parts_of_numpy()
    from mortarbench.answer import solver_session
    from mortarbench.case import Case
    from mortarbench.progress import waiting

    pictures = [o for o in ("plot", "vtu") if getattr(options, o) is not None]
    is_builtin = registries.hold_only_builtins()
    session = solver_session(
        options.solver,
        registries,
        changed,
        ranks=options.mpi,
        time_limit=options.time_limit,
    )
    with session as solve, waiting() as progress:
        progress(f"building {parsed.name}")
        case = Case(id=parsed, registries=registries)
        if pictures or options.mpi == 1 or not is_builtin:
            # built while the worker starts
            _build(case, pictures)
        limit = f"time limit {options.time_limit:g} s"
        progress(f"solving {parsed.name} with {options.solver}, {limit}")
        answer = solve(case, options.tol)
    _print(answer, options)
    if pictures or options.out is not None:
        _write(answer, options)
    return 0 if answer.verdict.is_verified else 1


def _print(answer: Answer, options: Namespace) -> None:
    """Print the answer and the table of its convergence."""
    from mortarbench.harness.record import Verdict

    record = answer.record
    if options.json:
        print(json.dumps(answer.to_dict(), allow_nan=False))
    elif record.status is not Verdict.DECLINED:
        print(answer)
        from mortarbench.text import convergence, legend

        if table := convergence(answer.history):
            print(f"\n{table}")
            if text := legend(answer.history):
                print(f"\n{text}")
    if record.status is Verdict.DECLINED:
        say(f"{record.solver} declines {record.case}: {record.message}{_hint(answer)}")


def _build(case: Case, pictures: Sequence[str]) -> None:
    """Build the case.

    pictures : options for pictures on the command line

    Raises
    ------
    InputError
        If pictures are requested and the case has no bodies.

    """
    fields = case.family_case.fields
    if pictures and fields is None:
        names = ", ".join(f"--{o}" for o in pictures)
        raise InputError(f"{case.name} has no bodies to draw; leave out {names}")


def _hint(answer: Answer) -> str:
    """Return a hint to use the dual form if the solver declined inequality rows."""
    case = answer.case
    if case.form != "primal" or "dual" not in case.id.family.forms:
        return ""
    import numpy as np

    from mortarbench.harness import Box, Cones, Discs
    from mortarbench.harness.qp import no_rows
    from mortarbench.harness.registry import resolve
    from mortarbench.harness.verify.measure import reason_to_decline

    qp = case.family_case.qp
    n = qp.q.size
    # In the dual, multipliers of inequality rows have bounds; cones become discs.
    discs = [
        Discs(one.index[:, 1:], np.ones(len(one.index)))
        for one in qp.sets
        if isinstance(one, Cones)
    ]
    lower = np.zeros(n)
    for disc in discs:
        lower[disc.index] = -np.inf
    bounds = Box(lower, np.full(n, np.inf))
    like_dual = replace(qp, G=no_rows(n), h=qp.h[:0], sets=(bounds, *discs))
    solver = resolve(answer.spec, case.registries.solvers)
    try:
        dual = assemble(case.id.family, case.params, "dual").name
        # test the solver on a QP with bounds or discs instead of rows, like the dual
        reason = reason_to_decline(solver, like_dual)
    except Exception:  # code of a plug-in failed: no hint
        return ""
    return "" if reason else f"; dualise inequality rows first: solve {dual}"


def _write(answer: Answer, options: Namespace) -> None:
    """Write the requested files, unless the answer has no point."""
    if not answer.has_point:
        say(f"no file is written: {answer.record.solver} returned no point")
        return
    if options.out is not None:
        answer.save(options.out)
    if options.plot is not None:
        answer.plot(options.plot, scale=options.scale)
    if options.vtu is not None:
        answer.save_vtu(options.vtu)
