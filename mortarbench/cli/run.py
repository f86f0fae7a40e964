"""The command `run`: measure a suite and write its report."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from json import dumps
from typing import Annotated, Any

import mortarbench as mb
from mortarbench.harness.errors import some
from mortarbench.harness.suite.solver_options import parse_options
from mortarbench.progress import warnings_on
from mortarbench.registries import Registries


def run(
    registries: Registries,
    *,
    option: Annotated[Sequence[str], "KEY=VALUE"] = (),
    strict: bool = False,
    quiet: bool = False,
    json: bool = False,
    **arguments: Any,
) -> int:
    """Measure a suite and write a report on the results.

    Results are stored in a folder. The same command continues an interrupted run
    without repeating a measurement. Exit code 1: a measurement is missing.

    option : set an option of every solver that has it, or of one by SOLVER.KEY; if it
        is set several times, every value is measured
    strict : exit with 1 if a claim is refuted, or a solver fails or reaches a limit
    quiet : print only warnings and missing measurements
    json : print JSON
    """
    measured = mb.run(
        **arguments,
        options=parse_options(option),
        progress=warnings_on(sys.stderr) if quiet else True,
        registries=registries,
    )
    if not json and not quiet:
        print(measured)
    written = mb.Report(files=())
    if measured.records:
        written = mb.report(measured.folder)
    pages = [file for file in written.files if file.suffix == ".html"]
    failed = _strict_failure(measured) if strict else ""
    if json:
        print(dumps({**measured.to_dict(), "pages": [*map(str, pages)]}))
    else:
        lines = measured.shortfall if quiet else [*written.said, *pages]
        for line in [*lines, *[failed] * bool(failed)]:
            print(line)
    return 1 if measured.shortfall or failed else 0


def _strict_failure(measured: mb.Results) -> str:
    """Return the reason why a strict run fails, in one line; "" if it does not fail."""
    texts = [
        f"{len(records)} {what} "
        f"({some(dict.fromkeys(f'{r.solver} on {r.case}' for r in records))})"
        for records, what in (
            (measured.refuted, "refuted"),
            (measured.failed, "without an answer"),
        )
        if records
    ]
    return f"strict: measurements: {' and '.join(texts)}" if texts else ""
