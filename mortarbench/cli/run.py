"""The command `run`: a suite, measured and reported on."""

from __future__ import annotations

import sys
from argparse import Namespace
from pathlib import Path

from harness.files.durable import full_disk_told
from harness.suite.solver_options import given_options
from mortarbench.registries import Registries


def run(registries: Registries, options: Namespace) -> int:
    """Measure what the result folder lacks of a suite, and report; 1 if not all."""
    registries = registries.with_files(options.plugin)
    path: Path = registries.suite_path(options.suite)
    changed = given_options(options.option)

    from mortarbench import results
    from mortarbench.progress import shown_on
    from mortarbench.reporting import report

    with shown_on(sys.stderr) as progress:
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
    print(found)
    if found.records:
        with full_disk_told(found.folder):
            pages = report(found.folder, registries=registries).files
        for page in (file for file in pages if file.suffix == ".html"):
            print(page)
    return 1 if found.shortfall else 0
