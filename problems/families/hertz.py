"""Families of Hertzian line contact; see `problems.models.hertz`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from mortarbench.harness import InputError
from mortarbench.problems.families.declared import ContactFamily
from mortarbench.problems.ranges import (
    DECOMPOSITION,
    FRICTION,
    HALVINGS,
    KINEMATICS,
    METHODS,
    PLANES,
    STEPS,
    check_memory,
    check_tangential,
    choice,
    key,
    positive,
    schema,
    size,
)

if TYPE_CHECKING:
    from mortarbench.harness import Value


class HertzPlane(ContactFamily):
    """Hertz contact: an elastic half cylinder pressed onto a rigid plane."""

    name = "hertz-plane"
    keys = schema(
        n=key(10, 1),
        load=size(10.0),
        **PLANES,
        halvings=HALVINGS,
        **DECOMPOSITION,
        **KINEMATICS,
    )
    forms = ("primal", "dual")
    problem = "hertz.plane_problem"
    model = "hertz.newton_step"

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        super().check(params)
        check_memory(self.name, (int(params["n"]) * 2 ** int(params["halvings"])) ** 2)


class HertzCylinder(ContactFamily):
    """Hertz contact: an elastic half cylinder pressed onto another half cylinder."""

    name = "hertz-cylinder"
    keys = schema(
        n=key(10, 1),
        m=key(8, 1),
        load=size(1.0),
        ratio=size(1.0),
        slave=choice("lower", "upper").with_default("upper"),
        contact=METHODS["contact"].with_default("mortar"),
        basis=METHODS["basis"],
        **PLANES,
        halvings=HALVINGS,
        **FRICTION,
        Q=key(0.0),
        peak=key(0.0),
        programme=choice("normal-first", "proportional"),
        steps=STEPS.with_default(20),
        **DECOMPOSITION,
    )
    forms = ("primal", "dual")
    problem = "hertz.problem"

    def complete(self, given: Mapping[str, Value]) -> Mapping[str, Value]:
        """Return all keys; `peak` defaults to `Q`, which means no unloading."""
        return {**self.defaults, "peak": given.get("Q", 0.0), **given}

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range and has an effect."""
        super().check(params)
        check_memory(self.name, (int(params["n"]) * 2 ** int(params["halvings"])) ** 2)
        has_shear = bool(params["Q"] or params["peak"])
        proportional = params["programme"] == "proportional"
        if has_shear:
            for name, value in (("friction", "coulomb"), ("ratio", 1.0)):
                if params[name] != value:
                    raise InputError(
                        f"{self.name}: {name}={params[name]} is not supported with a "
                        f"tangential force; expected {name}={value}, or no Q and "
                        "no peak"
                    )
            check_tangential(self.name, params)
            positive(self.name, params, ("mu",))
        if params["loading"] == "static" and params["Q"] != params["peak"]:
            raise InputError(
                f"{self.name}: peak={params['peak']} is not used by loading=static; "
                "expected loading=quasi-static, which unloads"
            )
        if proportional and not (has_shear and params["Q"] == params["peak"]):
            raise InputError(
                f"{self.name}: programme=proportional requires Q > 0 and peak=Q "
                "(the default), that is, no unloading"
            )
        if params["steps"] != self.defaults["steps"] and not proportional:
            raise InputError(
                f"{self.name}: steps={params['steps']} is not used by "
                f"programme={params['programme']}; expected programme=proportional"
            )
