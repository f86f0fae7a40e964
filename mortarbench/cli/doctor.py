"""The command `doctor`: check whether this machine is suitable for measurements."""

from __future__ import annotations

from json import dumps

from mortarbench.registries import Registries


def doctor(registries: Registries, *, json: bool = False) -> int:
    """Check whether this machine is suitable for measurements, and recommend changes.

    json : print JSON
    """
    from mortarbench.harness.environment.doctor import advice, render
    from mortarbench.harness.environment.environment import digest

    environment = registries.environment()
    if json:
        changes = advice(environment)
        data = {"digest": digest(environment), "fit": not changes, "advice": changes}
        print(dumps(data | {"environment": environment}))
    else:
        print(render(environment, digest(environment)))
    return 0
