"""The paper's benchmark: an elastic beam pressed onto a half ring (Section 2).

A beam of 2 m × 0.25 m, its lower left corner at height 0.5 m, is clamped on the left
and pulled down by F₀ = 10⁸ N/m at its upper right corner; a half ring with radii 0.3 m
and 0.49 m around (1 m, 0), clamped at both feet, holds it up. The initial gap is 1 cm.

Errata of the paper that bite here: its 313 nodes for Nr = 4, Nh = 3 belong to a ring
with Nh radial layers (``radial=3``), text and Table 1 to 2·Nh (424 nodes); m_E counts
prescribed displacement components, 2(Nr + 1) + 4(radial + 1); plane strain and a force
per unit thickness are not stated but implied.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np

from harness import Case, Family, InputError, Reference, Value
from problems.contact.bodies import Bodies, ContactPair, assemble, clamped, floating
from problems.contact.linearise import METHODS, linearisation
from problems.contact.results import quantities
from problems.duality.case_forms import FORMS, contact_case
from problems.duality.stepping import LoadPath
from problems.families.ranges import (
    MOST_STEPS,
    at_least,
    at_most,
    doubled,
    fits,
    one_of,
)
from problems.fem.elasticity import Material, Plane
from problems.fem.inverse import GeneralisedInverse
from problems.fem.mesh import dofs_of, half_ring, join, rectangle

LENGTH = 2.0  #: l, m
LOAD = 1e8  #: F₀, N/m
BEAM = Material(E=200e9, nu=0.3)
MOST_NODES = 50_000_000  #: the entries of K are numbered by 32-bit integers
RING = Material(E=20e9, nu=0.3)


@dataclass(frozen=True)
class BeamRing(Family):
    """The paper's benchmark: beam on a half ring, plane elasticity, frictionless."""

    name: str = "beam-ring"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType({
            "Nr": 10, "Nh": 5, "radial": 0, "steps": 10, "step": 0,
            "contact": "nts", "basis": "dual", "relin": 1, "plane": "strain",
        }),
        hash=False,
    )  # fmt: skip
    forms: tuple[str, ...] = FORMS
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
        one_of(self.name, p, METHODS | {"plane": ("strain", "stress")})

    def refined(self, params: Mapping[str, Value]) -> Mapping[str, Value]:
        """Return the case with every cell halved; its load steps are linearised anew.

        The arcs of the ring are other polygons.
        """
        return {**params, **doubled(params, "Nr", "Nh", "radial")}

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Emit the QP of one load step in one form."""
        self.check(params)
        p: Any = params
        geometry = (p["Nr"], p["Nh"], p["radial"], p["plane"])
        bodies = model(*geometry)
        method = (p["contact"], p["basis"])
        path = _path(geometry, method, p["steps"], p["relin"], reference)
        primal = path.primal(p["step"])
        sides = bodies.mesh.boundaries
        tip = dofs_of(np.intersect1d(sides["top"], sides["right"]))
        return contact_case(
            bodies, primal, form,
            floating=lambda: _floating(*geometry),
            clamped=lambda: _clamped(*geometry),
            supported=lambda: _clamped(*geometry),
            quantities=lambda s: quantities(bodies, primal, s)
            | {"tip": (s.x[tip] * LENGTH).tolist()},
        )  # fmt: skip


@lru_cache(maxsize=4)
def model(Nr: int, Nh: int, radial: int, plane: Plane) -> Bodies:
    """Mesh and assemble beam (8Nr × Nr) and ring (12Nh × radial)."""
    beam = rectangle((0.0, 0.5), (LENGTH, 0.25), (8 * Nr, Nr))
    ring = half_ring((1.0, 0.0), (0.3, 0.49), (12 * Nh, radial))
    mesh, body = join((beam, ring))
    sides = mesh.boundaries
    clamps = [dofs_of(sides[b]) for b in ("left", "left_foot", "right_foot")]
    load = np.zeros(mesh.dofs)
    load[2 * np.intersect1d(sides["top"], sides["right"]) + 1] = -LOAD
    return assemble(
        mesh, body, names=("beam", "ring"), materials=(BEAM, RING), plane=plane,
        units=(LENGTH, LOAD), fixed=np.concatenate(clamps), load=load,
        pairs=(ContactPair(slave=sides["outer"], master=sides["bottom"]),),
    )  # fmt: skip


@lru_cache(maxsize=4)
def _floating(*geometry: Any) -> GeneralisedInverse:
    return floating(model(*geometry))


@lru_cache(maxsize=4)
def _clamped(*geometry: Any) -> GeneralisedInverse:
    return clamped(model(*geometry))


@lru_cache(maxsize=4)
def _path(
    geometry: tuple[Any, ...],
    method: tuple[Any, Any],
    steps: int,
    relin: int,
    reference: Reference,
) -> LoadPath:
    linearise = linearisation(model(*geometry), *method)
    return LoadPath(
        model(*geometry), linearise, _clamped(*geometry), reference, steps, relin
    )
