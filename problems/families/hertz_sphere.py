"""The family of Hertzian point contact; see `problems.models.solids.hertz_sphere`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from mortarbench.harness import InputError
from mortarbench.problems.families.declared import ContactFamily
from mortarbench.problems.ranges import (
    DECOMPOSITION,
    check_memory,
    choice,
    key,
    schema,
    size,
)

if TYPE_CHECKING:
    from mortarbench.harness import Value


class HertzSphere(ContactFamily):
    """Hertz contact in space: an elastic sphere pressed onto a rigid plane."""

    name = "hertz-sphere"
    keys = schema(
        n=key(8, 1),
        against=choice("plane"),
        R=size(8.0),
        E=size(200.0),
        nu=key(0.3),
        load=size(10.0),
        **DECOMPOSITION,
    )
    forms = ("primal", "dual")
    problem = "solids.hertz_sphere.problem"

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        super().check(params)
        check_memory(self.name, 3 * int(params["n"]) ** 3)
        if not -1 < float(params["nu"]) < 0.5:
            raise InputError(
                f"{self.name}: nu={params['nu']} must be between -1 and 0.5"
            )
