"""The command `doctor`: check whether this machine is suitable for measurements."""

from __future__ import annotations

import json
from argparse import Namespace

from mortarbench.registries import Registries


def run(registries: Registries, options: Namespace) -> int:
    """Describe this machine, and recommend changes for better measurements."""
    from rich.console import Console

    from mortarbench.harness.environment.doctor import as_json, examine, render
    from mortarbench.harness.environment.environment import digest

    environment = registries.environment()
    checks = examine(environment)
    if options.json:
        print(json.dumps(as_json(environment, checks)))
    else:
        text = render(checks, digest(environment))
        Console(highlight=False, soft_wrap=True).print(text)
    return 0
