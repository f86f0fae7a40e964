"""The command `merge`: merge result folders into one."""

from __future__ import annotations

from argparse import Namespace

from mortarbench.arguments import check_result_folder
from mortarbench.harness.errors import say
from mortarbench.registries import Registries


def run(registries: Registries, options: Namespace) -> int:
    """Merge result folders and print a summary of the new one."""
    for folder in options.folders:
        check_result_folder(folder)

    from mortarbench.results import merge

    results = merge(*options.folders, out=options.out, tell=say)
    environments = len({r.environment for r in results.records})
    print(results)
    print(f"{options.out}: {len(results)} measurements", end="")
    print(f", {environments} environments" if environments > 1 else "")
    return 0
