"""The families of Hertzian line contact; see `problems.models.hertz`."""

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
    MOST_STEPS,
    PLANES,
    at_least,
    at_most,
    deformed,
    fits,
    one_of,
    one_state,
    positive,
    rough,
    tangential,
    torn_by,
    without_friction,
)

if TYPE_CHECKING:
    from mortarbench.harness import Value


@dataclass(frozen=True)
class HertzPlane(ContactFamily):
    """Hertz contact: an elastic half cylinder pressed onto a rigid plane."""

    model = "hertz"
    stated_by = "on_plane"
    name: str = "hertz-plane"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType({
            "n": 10, "load": 10.0, "plane": "strain", "halvings": 0,
            **DECOMPOSITION, **KINEMATICS,
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
        torn_by(self.name, params)
        deformed(self.name, params)

    def refined(self, params: Mapping[str, Value]) -> Mapping[str, Value] | None:
        """Return the case with every cell halved; the arcs are other polygons."""
        one_state(self.name, params)
        return {**params, "halvings": int(params["halvings"]) + 1}


@dataclass(frozen=True)
class HertzCylinder(ContactFamily):
    """Hertz contact: an elastic half cylinder pressed onto another one."""

    model = "hertz"
    name: str = "hertz-cylinder"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType({
            "n": 10, "m": 8, "load": 1.0, "radius": 1.0, "ratio": 1.0,
            "slave": "upper", "contact": "mortar", "basis": "dual", "plane": "strain",
            "halvings": 0, **FRICTION, "Q": 0.0, "peak": 0.0,
            "programme": "normal-first", "steps": 20, **DECOMPOSITION,
        }),
        hash=False,
    )  # fmt: skip
    forms: tuple[str, ...] = ("primal", "dual")

    def complete(self, given: Mapping[str, Value]) -> Mapping[str, Value]:
        """Let the tangential force never have been larger than it is."""
        return {**self.defaults, "peak": given.get("Q", 0.0), **given}

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range, and used."""
        rough(self.name, params)
        self._check_tangential(params)
        at_least(1, self.name, params, ("n", "m"))
        at_least(0, self.name, params, ("halvings",))
        at_most(30, self.name, params, ("halvings",))
        fits(self.name, (int(params["n"]) * 2 ** int(params["halvings"])) ** 2)
        positive(self.name, params, ("load", "radius", "ratio"))
        one_of(self.name, params, {
            "slave": ("lower", "upper"), **METHODS, **PLANES,
        })  # fmt: skip
        torn_by(self.name, params)

    def _check_tangential(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless the keys of the tangential force fit together."""
        one_of(self.name, params, {"programme": ("normal-first", "proportional")})
        sheared = bool(params["Q"] or params["peak"])
        together = params["programme"] == "proportional"
        if sheared:
            for key, value in (("friction", "coulomb"), ("ratio", 1.0)):
                if params[key] != value:
                    raise InputError(
                        f"{self.name}: {key}={params[key]} with a tangential force; "
                        f"expected {key}={value}, or no Q and no peak"
                    )
            tangential(self.name, params)
            positive(self.name, params, ("mu",))
        if params["loading"] == "static" and params["Q"] != params["peak"]:
            raise InputError(
                f"{self.name}: peak={params['peak']} is not used by loading=static; "
                "expected loading=quasi-static, which unloads"
            )
        if together and not (sheared and params["Q"] == params["peak"]):
            raise InputError(
                f"{self.name}: programme=proportional needs Q, and no peak above it"
            )
        if params["steps"] != self.defaults["steps"] and not together:
            raise InputError(
                f"{self.name}: steps={params['steps']} is not used by "
                f"programme={params['programme']}; expected programme=proportional"
            )
        at_least(1, self.name, params, ("steps",))
        at_most(MOST_STEPS, self.name, params, ("steps",))

    def refined(self, params: Mapping[str, Value]) -> Mapping[str, Value]:
        """Return the case with every cell halved; the arcs are other polygons."""
        without_friction(self.name, params)
        return {**params, "halvings": int(params["halvings"]) + 1}
