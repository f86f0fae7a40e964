"""The command `report`: report on a result folder, or on changes between folders."""

from __future__ import annotations

import json
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

from mortarbench.arguments import FORMATS, GATES, check_names, check_result_folder
from mortarbench.harness.checked import positive
from mortarbench.harness.errors import InputError
from mortarbench.registries import Registries


def run(registries: Registries, options: Namespace) -> int:
    """Write the report; return 1 if a condition of ``--fail-on`` is met."""
    formats = options.format.split(",")
    check_names("format", formats, FORMATS, "--format")
    gates = options.fail_on.split(",") if options.fail_on is not None else []
    check_names("gate", gates, GATES, "--fail-on")
    if gates and not options.others:
        raise InputError("--fail-on needs a second folder; expected report DIR DIR2")
    if options.factor is not None:
        positive("--factor", options.factor)
    for folder in (options.folder, *options.others):
        check_result_folder(folder)
    from mortarbench.harness.record import VERIFIED_FACTOR
    from mortarbench.reporting import report

    result = report(
        options.folder,
        *options.others,
        formats=formats,
        factor=VERIFIED_FACTOR if options.factor is None else options.factor,
        fail_on=gates,
        pool_forms=options.pool_forms,
        registries=registries,
    )
    if options.json:
        print(json.dumps(result.to_dict(), allow_nan=False))
    else:
        paths = result.files if options.verbose else _main_paths(result.files)
        failed = [f"failed on {', '.join(result.failed_on)}"] * bool(result.failed_on)
        print(*result.said, *paths, *failed, sep="\n")
    return 1 if result.failed_on else 0


def _main_paths(files: Sequence[Path]) -> list[Path]:
    """Return the HTML pages, else the Markdown pages, else the folders of the files."""
    for suffix in (".html", ".md"):
        if pages := [file for file in files if file.suffix == suffix]:
            return pages
    return list(dict.fromkeys(file.parent for file in files))
