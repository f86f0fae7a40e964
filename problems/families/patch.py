"""The family of the contact patch test; see `problems.models.patch`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

from harness import Family, InputError
from problems.ranges import (
    DECOMPOSITION,
    FRICTION,
    METHODS,
    PLANES,
    at_least,
    doubled,
    fits,
    one_of,
    positive,
    rough,
    torn_by,
)

if TYPE_CHECKING:
    from harness import Case, Reference, Value


@dataclass(frozen=True)
class ContactPatch(Family):
    """Contact patch test: two blocks on each other under uniform pressure."""

    name: str = "contact-patch"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType({
            "lower": 6, "upper": 4, "slave": "upper", "ratio": 1.0,
            "contact": "mortar", "basis": "dual", "plane": "strain",
            **FRICTION, **DECOMPOSITION,
        }),
        hash=False,
    )  # fmt: skip
    forms: tuple[str, ...] = ("primal", "dual")

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        at_least(1, self.name, params, ("lower", "upper"))
        fits(self.name, int(params["lower"]) ** 2 + int(params["upper"]) ** 2)
        positive(self.name, params, ("ratio",))
        one_of(self.name, params, {
            "slave": ("lower", "upper"), **METHODS, **PLANES,
        })  # fmt: skip
        rough(self.name, params)
        torn_by(self.name, params)

    def refined(self, params: Mapping[str, Value]) -> Mapping[str, Value]:
        """Return the case with every cell halved; the odd row of cells is not.

        Coulomb's law is refused: its solutions minimise nothing.
        """
        if params["friction"] == "coulomb":
            raise InputError(
                f"{self.name}: friction=coulomb minimises no energy on any mesh; "
                "expected friction=tresca"
            )
        return {**params, **doubled(params, "lower", "upper")}

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Emit the QP in one form."""
        from problems.models.patch import two_blocks

        self.check(params)
        return two_blocks(form, params, reference)
