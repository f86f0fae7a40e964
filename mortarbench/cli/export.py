"""The command `export`: the QP of one case for other people's solvers."""

from __future__ import annotations

from argparse import Namespace

from mortarbench.arguments import EXPORTS, writable
from mortarbench.harness.names import parse
from mortarbench.registries import Registries


def run(registries: Registries, options: Namespace) -> int:
    """Write the QP of one case to a file."""
    writable(options.file, EXPORTS)
    registries = registries.with_files(options.plugin)
    parsed = parse(options.case, registries.families)

    from mortarbench.case import built_case

    print(built_case(parsed, registries).save(options.file))
    return 0
