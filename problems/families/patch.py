"""The family of the contact patch test; see `problems.models.patch`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

from mortarbench.harness import InputError
from mortarbench.problems.families.in_subdomains import ContactFamily
from mortarbench.problems.ranges import (
    DECOMPOSITION,
    FRICTION,
    KINEMATICS,
    METHODS,
    PLANES,
    SHORTEST,
    at_least,
    deformed,
    doubled,
    fits,
    minimised,
    one_of,
    one_state,
    positive,
    rough,
    torn_by,
)

if TYPE_CHECKING:
    from mortarbench.harness import Value


@dataclass(frozen=True)
class ContactPatch(ContactFamily):
    """Contact patch test: two blocks on each other under uniform pressure."""

    model = "patch"
    name: str = "contact-patch"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType({
            "lower": 6, "upper": 4, "slave": "upper", "ratio": 1.0,
            "contact": "mortar", "basis": "dual", "plane": "strain",
            **FRICTION, **DECOMPOSITION, **KINEMATICS, "stretch": 1.0,
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
        deformed(self.name, params)
        self._check_stretch(params)

    def _check_stretch(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless a stretch is given that pressure can bring about."""
        stretch = float(params["stretch"])
        if stretch == self.defaults["stretch"]:
            return
        if params["kinematics"] == "linear":
            raise InputError(
                f"{self.name}: stretch={stretch:g} is not used by kinematics=linear; "
                "expected no stretch, or kinematics=finite"
            )
        if not SHORTEST <= stretch < 1:
            raise InputError(
                f"{self.name}: stretch={stretch:g} must be at least {SHORTEST:g} and "
                "below 1: blocks on each other can only be pressed"
            )

    def refined(self, params: Mapping[str, Value]) -> Mapping[str, Value] | None:
        """Return the case with every cell halved; the odd row of cells is not.

        Coulomb's law is refused: its solutions minimise nothing. At finite strain there
        is none: the QP of another mesh is linearised at another state.
        """
        one_state(self.name, params)
        finer = doubled(params, "lower", "upper")
        meshes = "/".join(f"{key}={n}" for key, n in finer.items())
        minimised(self.name, [str(params["friction"])], meshes)
        return {**params, **finer}
