"""The command `merge`: one result folder of several."""

from __future__ import annotations

from argparse import Namespace

from mortarbench.arguments import existing
from mortarbench.harness.errors import say
from mortarbench.registries import Registries


def run(registries: Registries, options: Namespace) -> int:
    """Merge result folders, and say what the new one holds."""
    for folder in options.folders:
        existing(folder)

    from mortarbench.results import merge

    found = merge(*options.folders, out=options.out, tell=say)
    environments = len({r.environment for r in found.records})
    print(found)
    print(f"{options.out}: {len(found)} measurements", end="")
    print(f", {environments} environments" if environments > 1 else "")
    return 0
