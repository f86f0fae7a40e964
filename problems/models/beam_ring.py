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
from functools import lru_cache, partial
from typing import Any

import numpy as np

from mortarbench.harness import Case, Reference, Solution, Value
from mortarbench.problems.contact.bodies import (
    Bodies,
    ContactPair,
    assemble,
    clamped,
    floating,
)
from mortarbench.problems.contact.friction import FrictionLaw, law_of
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.results import quantities
from mortarbench.problems.duality.case_forms import contact_case
from mortarbench.problems.duality.newton import NewtonPath
from mortarbench.problems.duality.newton_case import newton_case, newton_path
from mortarbench.problems.duality.stepping import LoadPath
from mortarbench.problems.fem.elasticity import Material, Plane
from mortarbench.problems.fem.inverse import GeneralisedInverse
from mortarbench.problems.fem.mesh import (
    Nodes,
    StructuredGrid,
    dofs_of,
    half_ring_grid,
    join,
    joined_sides,
    rectangle_grid,
)
from mortarbench.problems.feti.elastic import (
    Displaced,
    SubdividedBodies,
    in_parts,
    linearised_by,
    load_path,
    posed_on,
    subdivide,
)
from mortarbench.problems.feti.emission import ProblemInParts
from mortarbench.problems.feti.structured import Layout
from mortarbench.problems.feti.tearing import structured_bodies

LENGTH = 2.0  #: l, m
LOAD = 1e8  #: F₀, N/m
NAMES = ("beam", "ring")
BEAM = Material(E=200e9, nu=0.3)
RING = Material(E=20e9, nu=0.3)


def load_step(form: str, params: Mapping[str, Value], reference: Reference) -> Case:
    """Emit the QP of one load step in one form."""
    p: Any = params
    geometry = (p["Nr"], p["Nh"], p["radial"], p["plane"])
    bodies = model(*geometry)
    method = (p["contact"], p["basis"])
    tip = _tip(bodies.mesh.boundaries)

    def tip_of(s: Solution) -> dict[str, Any]:
        return {"tip": (s.x[tip] * LENGTH).tolist()}

    if p["kinematics"] == "finite":
        finite = _newton_path(
            geometry, method, p["steps"], p["material"], p["contact_stiffness"],
            reference,
        )  # fmt: skip
        return newton_case(finite, form, p["step"], p["newton"], lambda _, s: tip_of(s))
    path = _path(
        geometry, method, p["steps"], p["relin"], law_of(params),
        p["loading"] == "quasi-static", reference,
    )  # fmt: skip
    problem = path.problem(p["step"], p["iterate"])
    primal, friction = problem.primal, problem.friction
    cut = partial(subdivided, p["feti"], *geometry)
    return contact_case(
        bodies, primal, form,
        torn=posed_on(params, cut, primal, friction),
        floating=lambda: _floating(*geometry),
        clamped=lambda: _clamped(*geometry),
        supported=lambda: _clamped(*geometry),
        quantities=lambda s: quantities(bodies, primal, s, friction) | tip_of(s),
        friction=friction,
    )  # fmt: skip


@lru_cache(maxsize=4)
def model(Nr: int, Nh: int, radial: int, plane: Plane) -> Bodies:
    """Mesh and assemble beam (8Nr × Nr) and ring (12Nh × radial)."""
    mesh, body = join(tuple(grid.mesh() for grid in _grids(Nr, Nh, radial)))
    sides = mesh.boundaries
    load = np.zeros(mesh.dofs)
    load[_tip(sides)[1]] = -LOAD
    return assemble(
        mesh, body, names=NAMES, materials=(BEAM, RING), plane=plane,
        units=(LENGTH, LOAD), fixed=_clamps(sides), load=load,
        pairs=(_pair(sides),),
    )  # fmt: skip


def in_subdomains(params: Mapping[str, Value]) -> ProblemInParts:
    """Describe a load step, and before it the first one and those between."""
    p: Any = params
    grids, laws = _grids(p["Nr"], p["Nh"], p["radial"]), (law_of(params),)
    sides, layout = joined_sides(grids), Layout.of(grids, p["feti"])
    tip, pairs = _tip(sides), (_pair(sides),)

    def posed(step: int, displaced: Displaced) -> ProblemInParts:
        return in_parts(
            layout, materials=(BEAM, RING), plane=p["plane"],
            units=(LENGTH, LOAD), names=NAMES, fixed=_clamps(sides),
            load=(tip[1:], np.array([-LOAD * (step / p["steps"])])), pairs=pairs,
            linearise=linearised_by(p["contact"], p["basis"], laws), laws=laws,
            glue=p["glue"], displaced=displaced, step=step, iterate=p["iterate"],
            results=lambda found, _: {"tip": (found.at(tip) * LENGTH).tolist()},
        )  # fmt: skip

    steps = np.repeat(np.arange(1, p["step"] + 1), p["relin"]).tolist()
    quasi_static = p["loading"] == "quasi-static"
    return load_path(posed, pairs, steps, quasi_static=quasi_static)


def _grids(Nr: int, Nh: int, radial: int) -> tuple[StructuredGrid, StructuredGrid]:
    return (
        rectangle_grid((0.0, 0.5), (LENGTH, 0.25), (8 * Nr, Nr)),
        half_ring_grid((1.0, 0.0), (0.3, 0.49), (12 * Nh, radial)),
    )


def _clamps(sides: Mapping[str, Nodes]) -> Nodes:
    clamped = [dofs_of(sides[b], 2) for b in ("left", "left_foot", "right_foot")]
    return np.concatenate(clamped)


def _pair(sides: Mapping[str, Nodes]) -> ContactPair:
    return ContactPair(slave=sides["outer"], master=sides["bottom"])


def _tip(sides: Mapping[str, Nodes]) -> Nodes:
    """Return both components of the upper right corner of the beam."""
    return dofs_of(np.intersect1d(sides["top"], sides["right"]), 2)


@lru_cache(maxsize=4)
def subdivided(
    most: int, Nr: int, Nh: int, radial: int, plane: Plane
) -> SubdividedBodies:
    """Cut beam and ring into subdomains of at most so many cells a side."""
    label = structured_bodies([(8 * Nr, Nr), (12 * Nh, radial)], most)
    layout = Layout.of(_grids(Nr, Nh, radial), most)
    return subdivide(model(Nr, Nh, radial, plane), label, layout)


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
    law: FrictionLaw,
    quasi_static: bool,
    reference: Reference,
) -> LoadPath:
    linearise = linearisation(model(*geometry), *method, [law])
    return LoadPath(
        model(*geometry), linearise, lambda: _clamped(*geometry), reference,
        steps, relin, laws=(law,), quasi_static=quasi_static,
    )  # fmt: skip


@lru_cache(maxsize=4)
def _newton_path(
    geometry: tuple[Any, ...],
    method: tuple[Any, Any],
    steps: int,
    material: str,
    contact_stiffness: str,
    reference: Reference,
) -> NewtonPath:
    bodies = model(*geometry)
    keys = {
        "material": material, "contact": method[0],
        "contact_stiffness": contact_stiffness,
    }  # fmt: skip
    return newton_path(bodies, linearisation(bodies, *method), keys, reference, steps)
