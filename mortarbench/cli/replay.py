"""The command `replay`: one stored measurement, made again."""

from __future__ import annotations

import json
from argparse import Namespace

from mortarbench.arguments import existing
from mortarbench.registries import Registries


def run(registries: Registries, options: Namespace) -> int:
    """Make one stored measurement again and compare; 0 if it is reproduced."""
    existing(options.folder)
    registries = registries.with_files(options.plugin)

    from mortarbench.replaying import render, replay

    found = replay(options.folder, options.run_id, registries=registries)
    print(json.dumps(found.to_dict()) if options.json else render(found))
    return 0 if found.reproduced else 1
