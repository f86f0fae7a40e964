"""The family of GRECO's plate with friction; see `problems.models.greco`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

from mortarbench.harness import InputError
from mortarbench.problems.families.in_subdomains import ContactFamily
from mortarbench.problems.ranges import (
    CONTACT_FORMS,
    DECOMPOSITION,
    MOST,
    at_least,
    fits,
    torn_by,
)

if TYPE_CHECKING:
    from mortarbench.harness import Value


@dataclass(frozen=True)
class Greco(ContactFamily):
    """GRECO's plate, pushed along a rigid plane with Coulomb friction (SSNV128)."""

    model = "greco"
    name: str = "greco"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType({
            "n": 32, "mu": 1.0, "iterate": 0, **DECOMPOSITION,
        }),
        hash=False,
    )  # fmt: skip
    forms: tuple[str, ...] = CONTACT_FORMS

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless there are cells and a coefficient of friction."""
        at_least(2, self.name, params, ("n",))
        fits(self.name, int(params["n"]) ** 2)
        if not 0 <= float(params["mu"]) <= MOST:
            raise InputError(
                f"{self.name}: mu={params['mu']}; expected a coefficient of friction "
                "of 0 or more"
            )
        at_least(0, self.name, params, ("iterate",))
        torn_by(self.name, params)
