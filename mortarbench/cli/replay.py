"""The command `replay`: repeat one stored measurement."""

from __future__ import annotations

import json
from argparse import Namespace

from mortarbench.arguments import check_result_folder
from mortarbench.registries import Registries


def run(registries: Registries, options: Namespace) -> int:
    """Repeat a stored measurement; return 0 if the stored verdict is reproduced."""
    check_result_folder(options.folder)
    registries = registries.with_files(options.plugin)

    from mortarbench.replaying import render, replay

    result = replay(options.folder, options.run_id, registries=registries)
    print(json.dumps(result.to_dict()) if options.json else render(result))
    return 0 if result.reproduced else 1
