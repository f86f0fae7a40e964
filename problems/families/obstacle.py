"""Family `obstacle`, with exact solutions; see `problems.models.obstacle`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from mortarbench.harness import InputError
from mortarbench.problems.families.declared import DeclaredFamily
from mortarbench.problems.ranges import (
    CONTACT_FORMS,
    DECOMPOSITION,
    check_memory,
    choice,
    key,
    schema,
)

if TYPE_CHECKING:
    from mortarbench.harness import Value


class Obstacle(DeclaredFamily):
    """A string or membrane over an obstacle, with an exact solution."""

    name = "obstacle"
    keys = schema(
        dim=choice(1, 2).with_default(2),
        n=key(20, 2),
        shape=choice("flat", "hemisphere"),
        **DECOMPOSITION,
    )
    forms = CONTACT_FORMS
    model = "obstacle.obstacle_case"

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        super().check(params)
        if params["shape"] == "hemisphere" and params["dim"] != 2:
            raise InputError(f"{self.name}: shape=hemisphere needs dim=2")
        check_memory(self.name, int(params["n"]) ** int(params["dim"]))

    def is_divided(self, params: Mapping[str, Value]) -> bool:
        """Return True for a decomposed membrane, and False for a string."""
        return params["dim"] == 2 and super().is_divided(params)
