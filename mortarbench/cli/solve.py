"""The command `solve`: run one solver on one case."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from json import dumps
from typing import TYPE_CHECKING, Annotated, Any

import mortarbench as mb
from mortarbench.answer import ARCHIVES, GRIDS, PICTURES, TIME_LIMIT, check_scale
from mortarbench.case import as_case
from mortarbench.harness import checked
from mortarbench.harness.errors import InputError, say
from mortarbench.harness.names import assemble
from mortarbench.harness.registry import check_name
from mortarbench.harness.suite.solver_options import parse_options
from mortarbench.progress import waiting
from mortarbench.registries import Registries
from mortarbench.text import convergence

if TYPE_CHECKING:
    from mortarbench.answer import Answer


def solve(
    registries: Registries,
    case: str,
    solver: str,
    *,
    option: Annotated[Sequence[str], "KEY=VALUE"] = (),
    plot: Annotated[str | None, "FILE.png|pdf|svg"] = None,
    scale: Annotated[float | None, "S"] = None,
    vtu: Annotated[str | None, "FILE.vtu"] = None,
    out: Annotated[str | None, "FILE.npz"] = None,
    json: bool = False,
    **arguments: Any,
) -> int:
    """Run one solver on one case, once, and verify its answer.

    Exit code 1: the answer is not verified.

    option : set an option of the solver
    plot : draw the deformed bodies with their stresses, and each contact enlarged
    scale : magnification of the displacements in the picture; default: 1 if the
        displacements are then visible, else a rounded value, which the picture states;
        magnified bodies in contact may appear to overlap
    vtu : write the deformed bodies for ParaView, and a CSV file for each contact;
        FILE.pvd: write all load steps up to this one
    out : write x, the multipliers y, z and z_box and, for bodies, the displacements of
        the nodes
    json : print JSON
    """
    files = {"plot": plot, "vtu": vtu, "out": out}
    _check_files(files, scale)
    check_name(solver, registries.solvers)
    options = {
        key: values[0] if len(values) == 1 else values
        for key, values in parse_options(option).items()
    }
    problem: str | mb.Case = case
    pictures = [f"--{name}" for name in ("plot", "vtu") if files[name] is not None]
    if pictures:
        problem = as_case(case, registries=registries)
        if problem.family_case.fields is None:
            raise InputError(
                f"{problem.name} has no bodies to draw; leave out {', '.join(pictures)}"
            )
    with waiting() as progress:
        limit = arguments.get("time_limit", TIME_LIMIT)
        progress(f"solving {case} with {solver}, time limit {limit:g} s")
        answer = mb.solve(
            problem, solver, options=options, registries=registries, **arguments
        )
    _print(answer, json)
    if any(files.values()) and not answer.has_point:
        say(f"no file is written: {solver} returned no point")
    else:
        _write(answer, **files, scale=scale)
    return 0 if answer.verdict.is_verified else 1


def _check_files(files: Mapping[str, str | None], scale: float | None) -> None:
    """Check the names of output files before the solve, whose answer would be lost."""
    suffixes = {"plot": PICTURES, "vtu": GRIDS, "out": ARCHIVES}
    for name, path in files.items():
        if path is not None:
            checked.output_file(path, suffixes[name])
    if scale is not None and files["plot"] is None:
        raise InputError(f"scale {scale:g} without --plot; expected --plot FILE")
    if scale is not None:
        check_scale(scale)


def _print(answer: Answer, json: bool) -> None:
    """Print the answer and the table of its convergence."""
    record, declined = answer.record, answer.verdict.value == "declined"
    if json:
        print(dumps(answer.to_dict(), allow_nan=False))
    elif not declined:
        texts = (str(answer), convergence(answer.history))
        print(*filter(None, texts), sep="\n\n")
    if declined:
        say(f"{record.solver} declines {record.case}: {record.message}{_hint(answer)}")


def _write(
    answer: Answer,
    plot: str | None,
    vtu: str | None,
    out: str | None,
    scale: float | None,
) -> None:
    """Write the requested files."""
    if out is not None:
        answer.save(out)
    if plot is not None:
        answer.plot(plot, scale=scale)
    if vtu is not None:
        answer.save_vtu(vtu)


def _hint(answer: Answer) -> str:
    """Return a hint to use the dual form, which has no inequality rows or cones."""
    case = answer.case
    if case.form != "primal" or "dual" not in case.id.family.forms:
        return ""
    from mortarbench.harness import Cones

    if not case.qp.h.size and not any(isinstance(s, Cones) for s in case.qp.sets):
        return ""
    name, family = case.id.family_name, case.id.family
    dual = assemble(name, family, case.params, "dual").name
    return f"; dualise inequality rows first: solve {dual}"
