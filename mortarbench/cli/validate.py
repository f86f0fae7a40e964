"""The command `validate`: do the answers that a result folder holds agree."""

from __future__ import annotations

import json
from argparse import Namespace

from mortarbench.arguments import budget, existing
from mortarbench.harness.errors import say
from mortarbench.registries import Registries


def run(registries: Registries, options: Namespace) -> int:
    """Cross-validate a result folder; 1 if a claim is refuted or answers disagree."""
    budget(options.budget, "--budget")
    existing(options.folder)
    registries = registries.with_files(options.plugin)

    from mortarbench.validation import validate

    found = validate(
        options.folder, budget=options.budget, progress=say, registries=registries
    )
    if options.json:
        print(json.dumps(found.to_dict(), allow_nan=False))
    else:
        print(found, *found.pages, sep="\n")
    return 0 if found.agreed else 1
