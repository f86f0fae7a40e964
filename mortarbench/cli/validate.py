"""The command `validate`: cross-validate the answers in a result folder."""

from __future__ import annotations

import json
from argparse import Namespace

from mortarbench.arguments import check_result_folder
from mortarbench.harness.errors import say
from mortarbench.registries import Registries


def run(registries: Registries, options: Namespace) -> int:
    """Cross-validate; return 1 if a claim is refuted or answers disagree."""
    check_result_folder(options.folder)
    registries = registries.with_files(options.plugin)

    from mortarbench.validation import validate

    result = validate(
        options.folder, budget=options.budget, progress=say, registries=registries
    )
    if options.json:
        print(json.dumps(result.to_dict(), allow_nan=False))
    else:
        print(result, *result.pages, sep="\n")
    return 0 if result.agreed else 1
