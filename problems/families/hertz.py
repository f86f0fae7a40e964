"""The families of Hertzian line contact; see `problems.models.hertz`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

from harness import Family
from problems.ranges import (
    METHODS,
    PLANES,
    at_least,
    at_most,
    fits,
    one_of,
    positive,
)

if TYPE_CHECKING:
    from harness import Case, Reference, Value


@dataclass(frozen=True)
class HertzPlane(Family):
    """Hertz contact: an elastic half cylinder pressed onto a rigid plane."""

    name: str = "hertz-plane"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType({
            "n": 10, "load": 10.0, "plane": "strain", "halvings": 0,
        }),
        hash=False,
    )  # fmt: skip
    forms: tuple[str, ...] = ("primal", "dual")

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        at_least(1, self.name, params, ("n",))
        at_least(0, self.name, params, ("halvings",))
        at_most(30, self.name, params, ("halvings",))
        fits(self.name, (int(params["n"]) * 2 ** int(params["halvings"])) ** 2)
        positive(self.name, params, ("load",))
        one_of(self.name, params, PLANES)

    def refined(self, params: Mapping[str, Value]) -> Mapping[str, Value]:
        """Return the case with every cell halved; the arcs are other polygons."""
        return {**params, "halvings": int(params["halvings"]) + 1}

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Emit the QP in one form."""
        from problems.models.hertz import cylinder_on_plane

        del reference  # the gap to a plane is linear in u
        self.check(params)
        return cylinder_on_plane(form, params)


@dataclass(frozen=True)
class HertzCylinder(Family):
    """Hertz contact: an elastic half cylinder pressed onto another one."""

    name: str = "hertz-cylinder"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType({
            "n": 10, "m": 8, "load": 1.0, "radius": 1.0, "ratio": 1.0,
            "slave": "upper", "contact": "mortar", "basis": "dual", "plane": "strain",
            "halvings": 0,
        }),
        hash=False,
    )  # fmt: skip
    forms: tuple[str, ...] = ("primal", "dual")

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        at_least(1, self.name, params, ("n", "m"))
        at_least(0, self.name, params, ("halvings",))
        at_most(30, self.name, params, ("halvings",))
        fits(self.name, (int(params["n"]) * 2 ** int(params["halvings"])) ** 2)
        positive(self.name, params, ("load", "radius", "ratio"))
        one_of(self.name, params, {
            "slave": ("lower", "upper"), **METHODS, **PLANES,
        })  # fmt: skip

    def refined(self, params: Mapping[str, Value]) -> Mapping[str, Value]:
        """Return the case with every cell halved; the arcs are other polygons."""
        return {**params, "halvings": int(params["halvings"]) + 1}

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Emit the QP, with contact linearised at the undeformed state, in one form."""
        from problems.models.hertz import cylinder_on_cylinder

        del reference
        self.check(params)
        return cylinder_on_cylinder(form, params)
