"""The command `report`: on a result folder, or on what changed between two."""

from __future__ import annotations

from argparse import Namespace

from harness.checked import positive
from mortarbench.arguments import check_formats, existing
from mortarbench.registries import Registries


def run(registries: Registries, options: Namespace) -> int:
    """Write the report on a result folder, or what changed between two."""
    formats = options.format.split(",")
    check_formats(formats, "--format")
    if options.factor is not None:
        positive("--factor", options.factor)
    for folder in filter(None, (options.folder, options.other)):
        existing(folder)
    from harness.record import VERIFIED_FACTOR
    from mortarbench.reporting import report

    found = report(
        options.folder,
        options.other,
        formats=formats,
        factor=VERIFIED_FACTOR if options.factor is None else options.factor,
        pool_forms=options.pool_forms,
        registries=registries,
    )
    pages = [file for file in found.files if file.suffix == ".html"]
    shown = found.files if options.other is None else pages or found.files
    print(*found.said, *shown, sep="\n")
    return 0
