"""Family `greco`: a plate with friction; see `problems.models.greco`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from mortarbench.harness import InputError
from mortarbench.problems.families.declared import ContactFamily
from mortarbench.problems.ranges import (
    CONTACT_FORMS,
    DECOMPOSITION,
    DIMENSION,
    MAX_SIZE,
    check_memory,
    key,
    schema,
)

if TYPE_CHECKING:
    from mortarbench.harness import Value


class Greco(ContactFamily):
    """GRECO's plate, pushed along a rigid plane with Coulomb friction (SSNV128)."""

    name = "greco"
    keys = schema(
        n=key(32, 2),
        mu=key(1.0),
        iterate=key(0, 0),
        **DECOMPOSITION,
        **DIMENSION,
        depth=key(1, 1),
    )
    forms = CONTACT_FORMS
    problem = "greco.problem"

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range and mu is not negative."""
        super().check(params)
        dim, n, depth = (int(params[key]) for key in ("dim", "n", "depth"))
        if dim == 2 and depth != self.defaults["depth"]:
            raise InputError(
                f"{self.name}: depth={depth} is not used by dim=2; expected no depth, "
                "or dim=3"
            )
        check_memory(self.name, n**2 if dim == 2 else 3 * n**2 * depth)
        if not 0 <= float(params["mu"]) <= MAX_SIZE:
            raise InputError(
                f"{self.name}: mu={params['mu']}; expected a coefficient of friction "
                "of 0 or more"
            )
