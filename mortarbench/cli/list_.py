"""The command `list`: solvers, problems and suites that there are."""

from __future__ import annotations

import json
from argparse import Namespace

from harness.errors import InputError
from mortarbench.registries import Registries


def run(registries: Registries, options: Namespace) -> int:
    """List what there is, one line each or as one JSON array."""
    from mortarbench.listing import problems, solvers, suites

    registries = registries.with_files(options.plugin)
    if options.markdown:
        if options.what != "solvers":
            raise InputError("--markdown is for list solvers only")
        from mortarbench.cli.solvers_page import solvers_page

        print(solvers_page(registries.solvers), end="")
        return 0
    found = {"problems": problems, "solvers": solvers, "suites": suites}
    rows = found[options.what](registries=registries)
    print(json.dumps(list(rows)) if options.json else rows)
    return 0
