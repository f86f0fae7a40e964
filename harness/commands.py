"""What each command does; stdout carries results, stderr progress and reasons."""

from __future__ import annotations

import json
import sys
from argparse import Namespace
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.console import Console

from harness import show
from harness.block import Opens, Unbuilt
from harness.build import build, unbuilt
from harness.capsule import block_of, open_capsule
from harness.cluster import on_cluster
from harness.describe import in_a_line, solvers_page
from harness.doctor import as_json, examine, load_advice, render
from harness.environment import capture, digest
from harness.errors import InputError, some, unknown
from harness.folder import keep_environment
from harness.generator import Generator
from harness.generator import serve as serve_cases
from harness.history import History
from harness.journal import read_journal
from harness.judge import blank, has_point, plain
from harness.matfile import save_mat
from harness.names import CaseName, canonical, completed, parse
from harness.noise import noise_floor
from harness.plugin import Case, Fields
from harness.progress import Progress, shown_on
from harness.qpfile import save_qp
from harness.record import Record, Verdict, finite
from harness.registry import SolverSpec, options_of, resolve
from harness.remote import measured_once
from harness.replay import compared
from harness.replay import render as show_comparison
from harness.run import run as run_suite
from harness.station import one_by_one
from harness.suite import load_suite, with_overrides
from harness.workbench import FORMATS, Workbench
from harness.worker import serve


def list_(workbench: Workbench, options: Namespace) -> int:
    """List what there is, one line each or as one JSON array."""
    workbench = workbench.with_files(options.plugin)
    if options.markdown:
        if options.what != "solvers":
            raise InputError("--markdown is for list solvers only")
        print(solvers_page(workbench.solvers), end="")
        return 0
    rows: list[dict[str, Any]]
    match options.what:
        case "problems":
            rows = [
                {
                    "name": name,
                    "description": show.first_sentence(family),
                    "defaults": completed(family, {}),
                    "forms": family.forms,
                }
                for name, family in workbench.families.items()
            ]
        case "solvers":
            rows = [
                {
                    "name": name,
                    "description": in_a_line(solver),
                    "options": options_of(solver),
                }
                for name, solver in workbench.solvers.items()
            ]
        case _:
            rows = [
                {
                    "name": path.stem,
                    "description": show.first_comment(path),
                    "path": str(path),
                }
                for path in sorted(workbench.suites.glob("*.toml"))
            ]
    print(json.dumps(plain(rows)) if options.json else show.listing(rows))
    return 0


def run(workbench: Workbench, options: Namespace) -> int:
    """Measure what the result folder lacks of a suite, and report; 1 if not all."""
    workbench = workbench.with_files(options.plugin)
    path = workbench.suite_path(options.suite)
    suite = with_overrides(
        load_suite(path, workbench.families, workbench.solvers),
        workbench.families,
        workbench.solvers,
        solvers=options.solver,
        cases=options.case,
        repeats=options.repeats,
        time_limit=options.time_limit,
        memory_limit=options.memory_limit,
    )
    out = options.out or Path("out") / suite.name
    environment = capture(options.plugin)
    if load_advice(load := environment["now"]["load"]):
        _say(f"other programs keep {load:.1f} cores busy; times will be less certain")
    with shown_on(sys.stderr) as progress:
        unbuilt_cases = run_suite(
            suite,
            families=workbench.families,
            out=out,
            commands=workbench.commands(suite.solvers, options.plugin),
            resolve=lambda spec: resolve(spec, workbench.solvers),
            environment=environment,
            digest=digest(environment),
            progress=progress,
            fresh=options.fresh,
            engine=_engine(options, out, environment, progress),
        )
    records = read_journal(out)
    print(show.summary(records, [s.label for s in suite.solvers]))
    if unbuilt_cases:
        cases = "case" if len(unbuilt_cases) == 1 else "cases"
        print(f"{len(unbuilt_cases)} {cases} could not be built: {some(unbuilt_cases)}")
    written = workbench.report(out, FORMATS) if records else []
    for page in (file for file in written if file.suffix == ".html"):
        print(page)
    return 1 if unbuilt_cases else 0


def _engine(
    options: Namespace, out: Path, environment: Mapping[str, Any], progress: Progress
) -> Opens:
    if options.dask is None:
        return one_by_one
    return on_cluster(
        options.dask,
        plugins=options.plugin,
        environment=environment,
        keep=lambda name, there: keep_environment(out, name, there),
        warn=progress.warn,
    )


def solve(workbench: Workbench, options: Namespace) -> int:
    """Measure one solver on one case, in a worker; 0 if we can verify its answer."""
    if not 0 < options.tol < 1:
        raise InputError(f"--tol = {options.tol}; expected a number between 0 and 1")
    if options.plot is not None:
        _check_writable(options.plot, (".png",))
    if options.vtu is not None:
        _check_writable(options.vtu, (".vtu", ".pvd"))
    workbench = workbench.with_files(options.plugin)
    name = parse(options.case, workbench.families)
    spec = SolverSpec(name=options.solver, label=options.solver)
    solver = resolve(spec, workbench.solvers)
    if options_of(solver).get("history") is False:  # what it costs is not at stake here
        spec = replace(spec, options={"history": True})
        solver = resolve(spec, workbench.solvers)
    case = _built(workbench, name)
    record = blank(
        name,
        canonical(name, workbench.families[name.family]),
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

    command = workbench.worker_command(spec, options.plugin)
    with redirect_stdout(sys.stderr):  # whatever the family prints
        record, solution = measured_once(command, case, record)
    _show(record, solution.history if solution else {}, options.json)
    if drawn and case.fields is not None:
        if solution is not None and has_point(solution):
            _draw(workbench, options, name, case.fields(solution))
        else:
            _say(f"no picture: {record.solver} returned no point")
    return 0 if record.status is Verdict.VERIFIED else 1


def _draw(
    workbench: Workbench, options: Namespace, name: CaseName, fields: Fields
) -> None:
    """Write the pictures that were asked for; for .pvd solve the steps before too."""
    if options.plot is not None:
        workbench.plot(fields, options.plot)
    if options.vtu is None:
        return
    if options.vtu.suffix == ".vtu":
        workbench.vtu(fields, options.vtu)
        return
    states, last = [], int(name.params.get("step", 1))
    spec = SolverSpec(name=options.solver, label=options.solver)
    command = workbench.worker_command(spec, options.plugin)
    for step in range(1, last):
        earlier = replace(name, params={**name.params, "step": step})
        case = _built(workbench, earlier)
        record = blank(
            earlier, "", spec, options={}, tol=options.tol, repeat=0, environment=""
        )
        _, solution = measured_once(command, case, record)
        if solution is None or not has_point(solution) or case.fields is None:
            raise InputError(f"{options.vtu}: no point at step {step}; write a .vtu")
        states.append((float(step), case.fields(solution)))
    workbench.series([*states, (float(last), fields)], options.vtu)


def export(workbench: Workbench, options: Namespace) -> int:
    """Write the QP of one case for other people's solvers."""
    _check_writable(options.file, (".npz", ".mat"))
    workbench = workbench.with_files(options.plugin)
    name = parse(options.case, workbench.families)
    case = _built(workbench, name)
    meta = {
        "name": canonical(name, workbench.families[name.family]),
        "family": name.family,
        "params": name.params,
        "form": name.form,
        "units": "non-dimensional; energy in SI = scale * objective + constant",
        "scale": case.scale,
        "constant": case.constant,
    }
    if options.file.suffix == ".mat":
        save_mat(options.file, case.qp, plain(meta), case.matrices)
    else:
        save_qp(options.file, case.qp, plain(meta))
    print(options.file)
    return 0


def report(workbench: Workbench, options: Namespace) -> int:
    """Write the report on a result folder."""
    formats = options.format.split(",")
    for form in formats:
        if form not in FORMATS:
            raise unknown("format", form, FORMATS, where="--format")
    for file in workbench.report(options.folder, formats):
        print(file)
    return 0


def paper(workbench: Workbench, options: Namespace) -> int:
    """Measure what the paper's figures and tables show, and write them."""
    try:
        options.out.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise InputError(
            f"--out {options.out}: {e.strerror}; expected a folder, or none yet"
        ) from None
    for file in workbench.paper(options.out, options.quick, _say):
        if file.suffix == ".html":
            print(file)
    return 0


def doctor(_workbench: Workbench, options: Namespace) -> int:
    """Describe this machine and say what to change before measuring."""
    environment, noise = capture(), noise_floor()
    checks = examine(environment, noise)
    if options.json:
        print(json.dumps(as_json(environment, noise, checks)))
    else:
        text = render(checks, digest(environment))
        Console(highlight=False, soft_wrap=True).print(text)
    return 0


def replay(workbench: Workbench, options: Namespace) -> int:
    """Make one stored measurement again and compare; 0 if it is reproduced."""
    workbench = workbench.with_files(options.plugin)
    capsule = open_capsule(
        options.folder, options.run_id, workbench.families, workbench.solvers
    )
    environment = capture(options.plugin)
    block = block_of(
        capsule, workbench.families, workbench.solvers, digest(environment)
    )
    commands = workbench.commands([capsule.spec], options.plugin)
    with TemporaryDirectory(prefix="mortarbench-") as scratch:
        folder = Path(scratch)
        with one_by_one(commands, folder, folder / "cases") as carry_out:
            *_, result = carry_out(iter([block]))
    if isinstance(result, Unbuilt):
        raise InputError(f"{capsule.record.run_id}: {result.reason}")
    comparison = compared(options.folder, capsule, result, environment)
    if options.json:
        print(json.dumps(comparison.to_dict()))
    else:
        print(show_comparison(comparison))
    return 0 if comparison.reproduced else 1


def worker(workbench: Workbench, arguments: Sequence[str]) -> int:
    """Be the worker that `Workbench.worker_command` starts."""
    text, request_fd, reply_fd = arguments
    request = json.loads(text)
    workbench = workbench.with_files([Path(file) for file in request["plugins"]])
    spec = SolverSpec(
        name=request["name"], label=request["name"], options=request["options"]
    )
    serve(resolve(spec, workbench.solvers), int(request_fd), int(reply_fd))
    return 0


def generator(workbench: Workbench, arguments: Sequence[str]) -> int:
    """Be the generator that `Workbench.commands` starts."""
    text, request_fd, reply_fd = arguments
    files = [Path(file) for file in json.loads(text)["plugins"]]
    workbench = workbench.with_files(files)
    serve_cases(
        Generator(workbench.families, workbench.reference),
        int(request_fd),
        int(reply_fd),
    )
    return 0


def _built(workbench: Workbench, name: CaseName) -> Case:
    """Build a case; what a plug-in or too little memory prevents is no fault of ours.

    Raises
    ------
    InputError
        For both, and what the family itself refuses.

    """
    family = workbench.families[name.family]
    origin = workbench.origins.get(name.family)
    try:
        return build(name, family, workbench.reference)
    except InputError:
        raise
    except (Exception, SystemExit) as e:
        if origin is None and not isinstance(e, MemoryError):
            raise
        text = unbuilt(canonical(name, family), e)
        raise InputError(f"{origin}: {text}" if origin else text) from e


def _show(record: Record, history: History, as_json: bool) -> None:
    if as_json:
        row = {**json.loads(record.to_json()), "history": finite(plain(history))}
        print(json.dumps(row, allow_nan=False))
    elif record.status is not Verdict.DECLINED:
        print(show.outcome(record))
        if table := show.convergence(history):
            print(f"\n{table}")
    if record.status is Verdict.DECLINED:
        _say(f"{record.solver} declines {record.case}: {record.message}")


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


def _say(text: str) -> None:
    with suppress(BrokenPipeError):  # nobody listens: no reason to stop
        print(f"mortarbench: {text}", file=sys.stderr)
