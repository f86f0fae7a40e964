"""The command `doctor`: check whether this machine is suitable for measurements."""

from __future__ import annotations

from json import dumps

from mortarbench.registries import Registries


def doctor(registries: Registries, *, json: bool = False) -> int:
    """Check whether this machine is suitable for measurements, and recommend changes.

    json : print JSON
    """
    from rich.console import Console

    from mortarbench.harness.environment.doctor import as_json, examine, render
    from mortarbench.harness.environment.environment import digest

    environment = registries.environment()
    checks = examine(environment)
    if json:
        print(dumps(as_json(environment, checks)))
    else:
        text = render(checks, digest(environment))
        Console(highlight=False, soft_wrap=True).print(text)
    return 0
