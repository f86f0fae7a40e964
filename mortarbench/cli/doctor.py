"""The command `doctor`: check whether this machine is suitable for measurements."""

from __future__ import annotations

import json
from argparse import Namespace

from mortarbench.registries import Registries


def run(registries: Registries, options: Namespace) -> int:
    """Describe this machine, and recommend changes for better measurements."""
    from rich.console import Console

    from mortarbench.harness.environment.doctor import advice, render
    from mortarbench.harness.environment.environment import digest

    environment = registries.environment()
    if options.json:
        changes = advice(environment)
        data = {"digest": digest(environment), "fit": not changes, "advice": changes}
        print(json.dumps(data | {"environment": environment}))
    else:
        text = render(environment, digest(environment))
        Console(highlight=False, soft_wrap=True).print(text)
    return 0
