"""The command `export`: write the QP of a case for other programs."""

from __future__ import annotations

from argparse import Namespace

from mortarbench.arguments import EXPORTS, check_output_file
from mortarbench.harness.names import parse
from mortarbench.registries import Registries


def run(registries: Registries, options: Namespace) -> int:
    """Write the QP of a case to a file."""
    check_output_file(options.file, EXPORTS)
    registries = registries.with_files(options.plugin)
    parsed = parse(options.case, registries.families)

    from mortarbench.case import build_case

    print(build_case(parsed, registries).save(options.file))
    return 0
