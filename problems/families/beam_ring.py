"""The family of the paper's benchmark; see `problems.models.beam_ring`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from mortarbench.harness import InputError
from mortarbench.problems.families.in_subdomains import ContactFamily
from mortarbench.problems.ranges import (
    CONTACT_FORMS,
    CONTACT_STIFFNESS,
    DECOMPOSITION,
    FRICTION,
    KINEMATICS,
    METHODS,
    MOST_STEPS,
    PLANES,
    at_least,
    at_most,
    deformed,
    doubled,
    fits,
    one_of,
    one_state,
    rough,
    torn_by,
    without_friction,
)

if TYPE_CHECKING:
    from mortarbench.harness import Value

MOST_NODES = 50_000_000  #: the entries of K are numbered by 32-bit integers


@dataclass(frozen=True)
class BeamRing(ContactFamily):
    """The paper's benchmark: beam on a half ring, plane elasticity."""

    model = "beam_ring"
    name: str = "beam-ring"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType({
            "Nr": 10, "Nh": 5, "radial": 0, "steps": 10, "step": 0,
            "contact": "nts", "basis": "dual", "relin": 1, "plane": "strain",
            **FRICTION, **DECOMPOSITION,
            **KINEMATICS, **CONTACT_STIFFNESS,
        }),
        hash=False,
    )  # fmt: skip
    forms: tuple[str, ...] = CONTACT_FORMS
    #: the energy under the point load grows like log 1/h
    singular: str = "the work of a point load grows without bound as its cell shrinks"

    def complete(self, given: Mapping[str, Value]) -> Mapping[str, Value]:
        """Fill in the keys left out; radial defaults to 2·Nh, step to steps."""
        params: dict[str, Any] = {**self.defaults, **given}
        derived = {"radial": 2 * params["Nh"], "step": params["steps"]}
        return params | {k: v for k, v in derived.items() if k not in given}

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        p: Any = params
        at_least(1, self.name, p, ("Nr", "Nh", "radial", "steps", "step", "relin"))
        at_most(MOST_STEPS, self.name, p, ("steps", "relin"))
        nodes = (8 * p["Nr"] + 1) * (p["Nr"] + 1)
        nodes += (12 * p["Nh"] + 1) * (p["radial"] + 1)
        if nodes > MOST_NODES:
            raise InputError(
                f"{self.name}: Nr={p['Nr']}, Nh={p['Nh']} make {nodes:.2g} nodes; "
                f"expected at most {MOST_NODES:.2g}"
            )
        fits(self.name, 2 * nodes)
        if p["step"] > p["steps"]:
            raise InputError(
                f"{self.name}: step={p['step']} must be in 1..steps={p['steps']}"
            )
        one_of(self.name, p, METHODS | PLANES)
        rough(self.name, p)
        torn_by(self.name, p)
        deformed(self.name, p)

    def refined(self, params: Mapping[str, Value]) -> Mapping[str, Value] | None:
        """Return the case with every cell halved; its load steps are linearised anew.

        The arcs of the ring are other polygons. At finite strain there is none: the
        QP of another mesh is linearised at another state.
        """
        one_state(self.name, params)
        without_friction(self.name, params)
        return {**params, **doubled(params, "Nr", "Nh", "radial")}
