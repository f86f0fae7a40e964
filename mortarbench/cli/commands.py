"""What each command does; stdout carries results, stderr progress and reasons."""

from __future__ import annotations

import json
import sys
from argparse import Namespace
from collections.abc import Mapping
from functools import partial
from operator import attrgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.console import Console

from harness.checked import positive
from harness.environment.doctor import as_json, examine, load_advice, render
from harness.environment.environment import capture, digest
from harness.environment.noise import noise_floor
from harness.errors import FaultError, InputError, say, some, unknown
from harness.files.durable import full_disk_told
from harness.names import completed
from harness.recipe import Maker
from harness.registry import options_of, resolve
from harness.results.faults import in_words
from harness.results.folder import keep_environment
from harness.results.journal import read_journal
from harness.results.stored_run import block_of, open_capsule
from harness.results.work_unit import Opens, Unbuilt, Unmade
from harness.running.cluster import on_cluster
from harness.running.executor import one_by_one
from harness.running.progress import Progress, shown_on
from harness.running.run import run as run_suite
from harness.suite.overrides import with_overrides
from harness.suite.suite import load_suite
from harness.verify.verdicts import plain
from mortarbench.cli import text as show
from mortarbench.cli.list_ import in_a_line, solvers_page
from mortarbench.cli.registries import FORMATS, Registries
from mortarbench.cli.replay import compared
from mortarbench.cli.replay import render as show_comparison


def list_(registries: Registries, options: Namespace) -> int:
    """List what there is, one line each or as one JSON array."""
    registries = registries.with_files(options.plugin)
    if options.markdown:
        if options.what != "solvers":
            raise InputError("--markdown is for list solvers only")
        print(solvers_page(registries.solvers), end="")
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
                for name, family in registries.families.items()
            ]
        case "solvers":
            rows = [
                {
                    "name": name,
                    "description": in_a_line(solver),
                    "options": options_of(solver),
                }
                for name, solver in registries.solvers.items()
            ]
        case _:
            rows = [
                {
                    "name": path.stem,
                    "description": show.first_comment(path),
                    "path": str(path),
                }
                for path in sorted(
                    registries.suites.glob("*.toml"), key=attrgetter("stem")
                )
            ]
    print(json.dumps(plain(rows)) if options.json else show.listing(rows))
    return 0


def run(registries: Registries, options: Namespace) -> int:
    """Measure what the result folder lacks of a suite, and report; 1 if not all."""
    ours = registries.operators
    registries = registries.with_files(options.plugin)
    path = registries.suite_path(options.suite)
    suite = with_overrides(
        load_suite(path, registries.families, registries.solvers),
        registries.families,
        registries.solvers,
        solvers=options.solver,
        cases=options.case,
        repeats=options.repeats,
        time_limit=options.time_limit,
        memory_limit=options.memory_limit,
    )
    out = options.out or Path("out") / suite.name
    environment = capture(options.plugin)
    if load_advice(load := environment["now"]["load"]):
        say(f"other programs keep {load:.1f} cores busy; times will be less certain")
    with shown_on(sys.stderr) as progress:
        missing = run_suite(
            suite,
            out=out,
            commands=registries.commands(suite.solvers, options.plugin),
            resolve=lambda spec: resolve(spec, registries.solvers),
            environment=environment,
            digest=digest(environment),
            progress=progress,
            fresh=options.fresh,
            engine=_cluster(options, ours, out, environment, progress)
            if options.dask is not None
            else partial(one_by_one, operators=registries.operators),
        )
    records = read_journal(out, say)
    print(show.summary(records, [s.label for s in suite.solvers]))
    if count := len(missing.unbuilt):
        cases = "case" if count == 1 else "cases"
        print(f"{count} {cases} could not be built: {some(missing.unbuilt)}")
    if missing.faults:
        print(f"{in_words(missing.faults)}; the same command tries again")
    with full_disk_told(out):
        written = registries.report(out, FORMATS) if records else []
    for page in (file for file in written if file.suffix == ".html"):
        print(page)
    return 1 if missing.unbuilt or missing.faults else 0


def _cluster(
    options: Namespace,
    operators: Mapping[str, Maker],
    out: Path,
    environment: Mapping[str, Any],
    progress: Progress,
) -> Opens:
    return on_cluster(
        options.dask,
        plugins=options.plugin,
        operators=operators,
        environment=environment,
        keep=lambda name, there: keep_environment(out, name, there),
        warn=progress.warn,
    )


def report(registries: Registries, options: Namespace) -> int:
    """Write the report on a result folder, or what changed between two."""
    formats = options.format.split(",")
    for form in formats:
        if form not in FORMATS:
            raise unknown("format", form, FORMATS, where="--format")
    factor = positive("--factor", options.factor)
    if options.other is None:
        with full_disk_told(options.folder):
            written = registries.report(options.folder, formats, factor=factor)
        print(*written, sep="\n")
        return 0
    with full_disk_told(options.other):
        said, written = registries.compare(
            options.folder, options.other, formats, factor=factor
        )
    pages = [file for file in written if file.suffix == ".html"]
    print(*said, *(pages or written), sep="\n")
    return 0


def paper(registries: Registries, options: Namespace) -> int:
    """Measure what the paper's figures and tables show, and write them."""
    try:
        options.out.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise InputError(
            f"--out {options.out}: {e.strerror}; expected a folder, or none yet"
        ) from None
    with full_disk_told(options.out):
        written = registries.paper(options.out, options.quick, say)
    for file in written:
        if file.suffix == ".html":
            print(file)
    return 0


def doctor(_workbench: Registries, options: Namespace) -> int:
    """Describe this machine and say what to change before measuring."""
    environment, noise = capture(), noise_floor()
    checks = examine(environment, noise)
    if options.json:
        print(json.dumps(as_json(environment, noise, checks)))
    else:
        text = render(checks, digest(environment))
        Console(highlight=False, soft_wrap=True).print(text)
    return 0


def replay(registries: Registries, options: Namespace) -> int:
    """Make one stored measurement again and compare; 0 if it is reproduced."""
    registries = registries.with_files(options.plugin)
    capsule = open_capsule(
        options.folder, options.run_id, registries.families, registries.solvers
    )
    environment = capture(options.plugin)
    block = block_of(capsule, registries.solvers, digest(environment))
    commands = registries.commands([capsule.spec], options.plugin)
    with TemporaryDirectory(prefix="mortarbench-") as scratch:
        folder = Path(scratch)
        operators = registries.operators
        with one_by_one(
            commands, folder, folder / "cases", operators=operators
        ) as execute:
            *_, result = execute(iter([block]))
    if isinstance(result, Unbuilt):
        raise InputError(f"{capsule.record.run_id}: {result.reason}")
    if isinstance(result, Unmade):
        raise FaultError(f"{capsule.record.run_id}: {result.reason}")
    comparison = compared(options.folder, capsule, result, environment)
    if options.json:
        print(json.dumps(comparison.to_dict()))
    else:
        print(show_comparison(comparison))
    return 0 if comparison.reproduced else 1
