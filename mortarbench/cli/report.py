"""The command `report`: on a result folder, or on what changed between two."""

from __future__ import annotations

from argparse import Namespace

from harness.checked import positive
from mortarbench.arguments import existing
from mortarbench.registries import Registries
from mortarbench.reporting import check_formats, report


def run(registries: Registries, options: Namespace) -> int:
    """Write the report on a result folder, or what changed between two."""
    formats = options.format.split(",")
    check_formats(formats, "--format")
    factor = positive("--factor", options.factor)
    for folder in filter(None, (options.folder, options.other)):
        existing(folder)
    found = report(
        options.folder,
        options.other,
        formats=formats,
        factor=factor,
        registries=registries,
    )
    pages = [file for file in found.files if file.suffix == ".html"]
    shown = found.files if options.other is None else pages or found.files
    print(*found.said, *shown, sep="\n")
    return 0
