"""The commands on a single case: measure one solver on it, or write its QP."""

from __future__ import annotations

import json
import sys
from argparse import Namespace
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

from harness.environment.environment import capture, digest
from harness.errors import InputError, say
from harness.files.matfile import save_mat
from harness.files.parquetfile import save_parquet
from harness.files.qpfile import save_qp
from harness.names import CaseId, assemble, parse, unbuilt
from harness.plugin import Case, Fields
from harness.processes.measurement import measured_once
from harness.record import Record, Verdict, finite
from harness.registry import SolverSpec, options_of, resolve
from harness.solution import History
from harness.verify.verdicts import has_point, new_record, plain
from mortarbench.cli import text as show
from mortarbench.cli.registries import Registries


def solve(registries: Registries, options: Namespace) -> int:
    """Measure one solver on one case, in a worker; 0 if we can verify its answer."""
    if not 0 < options.tol < 1:
        raise InputError(f"--tol = {options.tol}; expected a number between 0 and 1")
    if options.plot is not None:
        _check_writable(options.plot, (".png",))
    if options.vtu is not None:
        _check_writable(options.vtu, (".vtu", ".pvd"))
    registries = registries.with_files(options.plugin)
    name = parse(options.case, registries.families)
    spec = SolverSpec(name=options.solver, label=options.solver)
    solver = resolve(spec, registries.solvers)
    if options_of(solver).get("history") is False:  # what it costs is not at stake here
        spec = replace(spec, options={"history": True})
        solver = resolve(spec, registries.solvers)
    case = _built(registries, name)
    record = new_record(
        name,
        spec,
        options=options_of(solver),
        tol=options.tol,
        repeat=0,
        environment=digest(capture(options.plugin)),
    )
    drawn = [o for o in ("plot", "vtu") if getattr(options, o) is not None]
    if drawn and case.fields is None:
        wanted = ", ".join(f"--{o}" for o in drawn)
        raise InputError(f"{record.case} has no bodies to draw; leave out {wanted}")

    command = registries.worker_command(spec, options.plugin)
    with redirect_stdout(sys.stderr):  # whatever the family prints
        record, solution = measured_once(command, case, record, registries.reference)
    _show(record, solution.history if solution else {}, options.json)
    if drawn and case.fields is not None:
        if solution is not None and has_point(solution):
            _draw(registries, options, name, case.fields(solution))
        else:
            say(f"no picture: {record.solver} returned no point")
    return 0 if record.status is Verdict.VERIFIED else 1


def _draw(
    registries: Registries, options: Namespace, name: CaseId, fields: Fields
) -> None:
    """Write the pictures that were asked for; for .pvd solve the steps before too."""
    if options.plot is not None:
        registries.plot(fields, options.plot)
    if options.vtu is None:
        return
    if options.vtu.suffix == ".vtu":
        registries.vtu(fields, options.vtu)
        return
    states, last = [], int(name.params.get("step", 1))
    spec = SolverSpec(name=options.solver, label=options.solver)
    command = registries.worker_command(spec, options.plugin)
    for step in range(1, last):
        earlier = assemble(name.family, {**name.params, "step": step}, name.form)
        case = _built(registries, earlier)
        record = new_record(
            earlier, spec, options={}, tol=options.tol, repeat=0, environment=""
        )
        _, solution = measured_once(command, case, record, registries.reference)
        if solution is None or not has_point(solution) or case.fields is None:
            raise InputError(f"{options.vtu}: no point at step {step}; write a .vtu")
        states.append((float(step), case.fields(solution)))
    registries.series([*states, (float(last), fields)], options.vtu)


def export(registries: Registries, options: Namespace) -> int:
    """Write the QP of one case for other people's solvers."""
    _check_writable(options.file, (".npz", ".mat", ".parquet"))
    registries = registries.with_files(options.plugin)
    name = parse(options.case, registries.families)
    case = _built(registries, name)
    meta = {
        "name": name.name,
        "family": name.family.name,
        "params": name.params,
        "form": name.form,
        "units": "non-dimensional; energy in SI = scale * objective + constant",
        "scale": case.scale,
        "constant": case.constant,
    }
    match options.file.suffix:
        case ".mat":
            save_mat(options.file, case.qp, plain(meta), case.matrices)
        case ".parquet":
            save_parquet(options.file, case.qp, plain(meta))
        case _:
            save_qp(options.file, case.qp, plain(meta))
    print(options.file)
    return 0


def _built(registries: Registries, name: CaseId) -> Case:
    """Build a case; what a plug-in or too little memory prevents is no fault of ours.

    Raises
    ------
    InputError
        For both, and what the family itself refuses.

    """
    origin = registries.origins.get(name.family.name)
    try:
        return name.build(registries.reference)
    except InputError:
        raise
    except (Exception, SystemExit) as e:
        if origin is None and not isinstance(e, MemoryError):
            raise
        text = unbuilt(name, e)
        raise InputError(f"{origin}: {text}" if origin else text) from e


def _show(record: Record, history: History, as_json: bool) -> None:
    if as_json:
        row = {**json.loads(record.to_json()), "history": finite(plain(history))}
        print(json.dumps(row, allow_nan=False))
    elif record.status is not Verdict.DECLINED:
        print(show.outcome(record))
        if table := show.convergence(history):
            print(f"\n{table}")
            if legend := show.legend(history):
                print(f"\n{legend}")
    if record.status is Verdict.DECLINED:
        say(f"{record.solver} declines {record.case}: {record.message}")


def _check_writable(path: Path, suffixes: tuple[str, ...]) -> None:
    """Refuse a file that could not be written before any work is done for it."""
    if path.suffix not in suffixes:
        raise InputError(
            f"{path}: unknown format {path.suffix!r}; expected {' or '.join(suffixes)}"
        )
    if path.is_dir():
        raise InputError(f"{path} is a folder; expected a file")
    if not path.parent.is_dir():
        raise InputError(f"{path}: no folder {path.parent}; expected one that exists")
