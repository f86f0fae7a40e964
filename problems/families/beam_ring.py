"""Family `beam-ring`, the paper's benchmark; see `problems.models.beam_ring`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from mortarbench.harness import InputError
from mortarbench.problems.families.declared import ContactFamily
from mortarbench.problems.ranges import (
    CONTACT_FORMS,
    CONTACT_STIFFNESS,
    DECOMPOSITION,
    FRICTION,
    KINEMATICS,
    MAX_STEPS,
    METHODS,
    PLANES,
    STEPS,
    check_memory,
    check_plane_only,
    choice,
    key,
    schema,
)

if TYPE_CHECKING:
    from mortarbench.harness import Value

#: largest number of nodes in the plane, due to 32-bit indices of the entries of K
MAX_NODES = 50_000_000


class BeamRing(ContactFamily):
    """The paper's benchmark: a beam on a half ring, plane or extruded."""

    name = "beam-ring"
    keys = schema(
        Nr=key(10, 1),
        Nh=key(5, 1),
        radial=key(0, 1),
        steps=STEPS,
        step=key(0, 1),
        **METHODS,
        relin=key(1, 1, MAX_STEPS),
        **PLANES,
        **FRICTION,
        **DECOMPOSITION,
        **KINEMATICS,
        **CONTACT_STIFFNESS,
        depth=key(0, 0),
        sides=choice("free", "plane-strain"),
    )
    forms = CONTACT_FORMS
    problem = "beam_ring.problem"
    model = "beam_ring.newton_step"

    def complete(self, given: Mapping[str, Value]) -> Mapping[str, Value]:
        """Return all keys; `radial` defaults to 2·Nh, and `step` to `steps`."""
        params: dict[str, Any] = {**self.defaults, **given}
        derived = {"radial": 2 * params["Nh"], "step": params["steps"]}
        return params | {k: v for k, v in derived.items() if k not in given}

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        super().check(params)
        p: Any = params
        nodes = (8 * p["Nr"] + 1) * (p["Nr"] + 1)
        nodes += (12 * p["Nh"] + 1) * (p["radial"] + 1)
        if nodes > MAX_NODES:
            raise InputError(
                f"{self.name}: Nr={p['Nr']}, Nh={p['Nh']} result in {nodes:.2g} nodes; "
                f"expected at most {MAX_NODES:.2g}"
            )
        check_memory(self.name, (3 * (p["depth"] + 1) if p["depth"] else 2) * nodes)
        if p["depth"]:
            check_plane_only(self.name, params, f"depth={p['depth']}")
        elif p["sides"] != self.defaults["sides"]:
            raise InputError(
                f"{self.name}: sides={p['sides']} is not used by depth=0; expected no "
                "sides, or depth=1 or more"
            )
