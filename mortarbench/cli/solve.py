"""The command `solve`: one solver on one case, once."""

from __future__ import annotations

import json
from argparse import Namespace
from typing import TYPE_CHECKING

from harness.errors import InputError, say
from harness.names import parse
from harness.registry import check_name
from harness.suite.solver_options import options_for
from mortarbench.arguments import GRIDS, PICTURES, tolerance, writable
from mortarbench.registries import Registries

if TYPE_CHECKING:
    from mortarbench.answer import Answer


def run(registries: Registries, options: Namespace) -> int:
    """Measure one solver on one case, in a worker; 0 if we can verify its answer."""
    tolerance(options.tol, "--tol")
    if options.plot is not None:
        writable(options.plot, PICTURES[:1])
    if options.vtu is not None:
        writable(options.vtu, GRIDS)
    registries = registries.with_files(options.plugin)
    parsed = parse(options.case, registries.families)
    check_name(options.solver, registries.solvers)
    changed = options_for(options.solver, options.option, registries.solvers)

    from harness.record import Verdict
    from mortarbench.answer import solve
    from mortarbench.case import built_case

    case = built_case(parsed, registries)
    drawn = [o for o in ("plot", "vtu") if getattr(options, o) is not None]
    if drawn and case.made.fields is None:
        wanted = ", ".join(f"--{o}" for o in drawn)
        raise InputError(f"{case.name} has no bodies to draw; leave out {wanted}")
    answer = solve(case, options.solver, tol=options.tol, options=changed)
    record = answer.record
    if options.json:
        print(json.dumps(answer.to_dict(), allow_nan=False))
    elif record.verdict is not Verdict.DECLINED:
        print(answer)
        _show_iterations(answer)
    if record.verdict is Verdict.DECLINED:
        say(f"{record.solver} declines {record.case}: {record.message}")
    if drawn:
        _draw(answer, options)
    return 0 if record.verdict is Verdict.VERIFIED else 1


def _show_iterations(answer: Answer) -> None:
    from mortarbench.text import convergence, legend

    if table := convergence(answer.history):
        print(f"\n{table}")
        if words := legend(answer.history):
            print(f"\n{words}")


def _draw(answer: Answer, options: Namespace) -> None:
    """Write the pictures that were asked for."""
    if not answer.has_point:
        say(f"no picture: {answer.record.solver} returned no point")
        return
    if options.plot is not None:
        answer.plot(options.plot)
    if options.vtu is not None:
        answer.save_vtu(options.vtu)
