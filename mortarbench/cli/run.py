"""The command `run`: a suite, measured and reported on."""

from __future__ import annotations

import json
import sys
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from mortarbench.harness.errors import some
from mortarbench.harness.files.durable import report_full_disk
from mortarbench.harness.suite.solver_options import given_options
from mortarbench.registries import Registries

if TYPE_CHECKING:
    from mortarbench.results import Results


def run(registries: Registries, options: Namespace) -> int:
    """Measure what the result folder lacks of a suite, and report.

    1 if not all was measured; by ``--strict``, if not all was solved.
    """
    registries = registries.with_files(options.plugin)
    path: Path = registries.suite_path(options.suite)
    changed = given_options(options.option)

    from mortarbench import results
    from mortarbench.progress import quiet_on, shown_on
    from mortarbench.reporting import report

    with quiet_on(sys.stderr) if options.quiet else shown_on(sys.stderr) as progress:
        found = results.run(
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
        print(found)
    pages: list[Path] = []
    said: tuple[str, ...] = ()
    if found.records:
        with report_full_disk(found.folder):
            written = report(found.folder, registries=registries)
        pages = [file for file in written.files if file.suffix == ".html"]
        said = written.said
    failed = len(found.refuted) + len(found.failed) if options.strict else 0
    if options.json:
        print(json.dumps({**found.to_dict(), "pages": [*map(str, pages)]}))
    else:
        summary = found.shortfall if options.quiet else [*said, *pages]
        for line in [*summary, *[_strict(found)] * bool(failed)]:
            print(line)
    return 1 if found.shortfall or failed else 0


def _strict(found: Results) -> str:
    """Say in a line why a strict run fails."""
    counts = (
        (found.refuted, "answer that refutes its claim", "answers that refute theirs"),
        (found.failed, "measurement without an answer", "measurements without one"),
    )
    told = [
        f"{len(records)} {one if len(records) == 1 else several} "
        f"({some(dict.fromkeys(f'{r.solver} on {r.case}' for r in records))})"
        for records, one, several in counts
        if records
    ]
    return f"strict: {' and '.join(told)}"
