"""The command `run`: measure a suite and write its report."""

from __future__ import annotations

import json
import sys
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from mortarbench.harness.errors import some
from mortarbench.harness.files.durable import report_full_disk
from mortarbench.harness.suite.solver_options import parse_options
from mortarbench.registries import Registries

if TYPE_CHECKING:
    from mortarbench.results import Results


def run(registries: Registries, options: Namespace) -> int:
    """Perform the missing measurements of a suite and write the report.

    Return 1 if a measurement is missing. With ``--strict``, also return 1 if a claim is
    refuted or a solver crashed, gave up or reached a limit.
    """
    registries = registries.with_files(options.plugin)
    path: Path = registries.suite_path(options.suite)
    changed = parse_options(options.option)

    from mortarbench import results
    from mortarbench.progress import display_on, warnings_on
    from mortarbench.reporting import report

    with (
        warnings_on(sys.stderr) if options.quiet else display_on(sys.stderr) as progress
    ):
        measured = results.run(
            path,
            out=options.out,
            solvers=options.solver,
            cases=options.case,
            repeats=options.repeats,
            time_limit=options.time_limit,
            memory_limit=options.memory_limit,
            options=changed,
            fresh=options.fresh,
            dask=options.dask,
            progress=progress,
            registries=registries,
        )
    if not options.json and not options.quiet:
        print(measured)
    pages: list[Path] = []
    statements: tuple[str, ...] = ()
    if measured.records:
        with report_full_disk(measured.folder):
            written = report(measured.folder, registries=registries)
        pages = [file for file in written.files if file.suffix == ".html"]
        statements = written.said
    failed = len(measured.refuted) + len(measured.failed) if options.strict else 0
    if options.json:
        print(json.dumps({**measured.to_dict(), "pages": [*map(str, pages)]}))
    else:
        summary = measured.shortfall if options.quiet else [*statements, *pages]
        for line in [*summary, *[_strict_failure(measured)] * bool(failed)]:
            print(line)
    return 1 if measured.shortfall or failed else 0


def _strict_failure(results: Results) -> str:
    """Return the reason why a strict run fails, in one line."""
    counts = (
        (results.refuted, "refuted claim", "refuted claims"),
        (
            results.failed,
            "measurement without an answer",
            "measurements without an answer",
        ),
    )
    texts = [
        f"{len(records)} {one if len(records) == 1 else several} "
        f"({some(dict.fromkeys(f'{r.solver} on {r.case}' for r in records))})"
        for records, one, several in counts
        if records
    ]
    return f"strict: {' and '.join(texts)}"
