"""The command `list`."""

from __future__ import annotations

from json import dumps
from typing import Literal

from mortarbench import listing
from mortarbench.registries import Plugins, Registries


def list_(
    registries: Registries,
    kind: Literal["problems", "solvers", "suites"],
    *,
    plugins: Plugins = (),
    json: bool = False,
) -> int:
    """List the available problems, solvers or suites.

    kind : what to list
    plugins : Python files with more solvers or families
    json : print JSON
    """
    functions = {
        "problems": listing.problems,
        "solvers": listing.solvers,
        "suites": listing.suites,
    }
    rows = functions[kind](registries=registries)
    print(dumps(list(rows)) if json else rows)
    return 0
