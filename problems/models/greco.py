"""GRECO's plate with Coulomb friction on a rigid plane (Code_Aster's SSNV128).

A square of 40 mm, in plane strain, lies on y = 0 with μ = 1. It is pressed down on its
top, pushed towards +x on its left side, and held on its right one:

    σ_y = −5e7 Pa at y = 40 mm,  σ_x = −15e7 Pa at x = 0,  u_x = 0 at x = 40 mm

and u_y = 0 at the corner (40 mm, 0), which has no contact row. The left end lifts off,
the middle slips and the right end sticks. Published are the tangential displacements of
five points of the contact side, ±5 %, and the normal force at 38.75 mm on 32 cells a
side (GRECO working group on friction; collected in Code_Aster's document V6.04.128).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from mortarbench.harness import QP, Case, Friction, Reference, Solution, Value, Vector
from mortarbench.problems.contact.bodies import (
    Bodies,
    ContactPair,
    ContactSides,
    assemble,
    clamped,
    floating,
    supported,
)
from mortarbench.problems.contact.friction import FrictionLaw
from mortarbench.problems.contact.results import quantities
from mortarbench.problems.contact.rigid_plane import above_plane
from mortarbench.problems.duality.case_forms import contact_case
from mortarbench.problems.duality.stepping import LoadPath
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.mesh import (
    Nodes,
    StructuredGrid,
    dofs_of,
    nodal_lengths,
    rectangle_grid,
)
from mortarbench.problems.feti.elastic import (
    AtSides,
    SubdividedBodies,
    in_parts,
    posed_on,
    subdivide,
    tresca_problems,
)
from mortarbench.problems.feti.emission import ProblemInParts
from mortarbench.problems.feti.own_bodies import OwnSolution
from mortarbench.problems.feti.structured import Layout
from mortarbench.problems.feti.tearing import blocks

SIDE = 0.04  #: m
MATERIAL = Material(E=1.3e11, nu=0.2)
NAMES = ("plate",)
TOP, LEFT = 5e7, 15e7  #: pressures, Pa
UNITS = (SIDE, TOP * SIDE)  #: l and F₀, m and N/m
PLACES = np.array([0.0, 1.25e-3, 5e-3, 7.5e-3, 11.25e-3])  #: m
PUBLISHED = np.array([2.86e-5, 2.72e-5, 2.28e-5, 1.98e-5, 1.50e-5])  #: u_x there, m
FORCE_AT = 38.75e-3  #: m


def greco(form: str, params: Mapping[str, Value], reference: Reference) -> Case:
    """Emit a Tresca problem of the fixed point in one form, the last unless asked."""
    p: Any = params
    path = _path(p["n"], p["mu"], reference)
    bodies, problem = path.bodies, path.problem(1, p["iterate"])
    primal, friction, count = problem.primal, problem.friction, path.iterates(1)
    return contact_case(
        bodies, primal, form,
        floating=lambda: floating(bodies), clamped=lambda: path.inverse,
        supported=lambda: supported(bodies), friction=friction,
        torn=posed_on(
            params, lambda: subdivided(bodies, p["n"], p["feti"]), primal, friction
        ),
        quantities=lambda s: quantities(bodies, primal, s, friction)
        | along_the_side(bodies, primal, s, friction) | {"tresca_problems": count},
    )  # fmt: skip


def plate(n: int) -> Bodies:
    """Mesh and assemble the plate with n × n cells."""
    grid = _grid(n)
    mesh, (component, force) = grid.mesh(), _pressure(grid)
    load = np.zeros(mesh.dofs)
    load[component] = force
    return assemble(
        mesh, np.zeros(n**2, dtype=np.int64), names=NAMES, materials=(MATERIAL,),
        plane="strain", units=UNITS, fixed=_supports(grid), load=load,
        pairs=(_on_rigid(grid),),
    )  # fmt: skip


def subdivided(bodies: Bodies, n: int, most: int) -> SubdividedBodies:
    """Cut the plate into subdomains of at most so many cells a side."""
    return subdivide(bodies, blocks((n, n), most), Layout.of((_grid(n),), most))


def in_subdomains(params: Mapping[str, Value]) -> ProblemInParts:
    """Describe the first problem of the fixed point in subdomains."""
    p: Any = params
    grid = _grid(p["n"])

    def results(found: OwnSolution, at: AtSides) -> dict[str, Any]:
        told = along_the_side(at.bodies, at.primal, at.solution, at.friction)
        return told | {"tresca_problems": tresca_problems(found)}

    return in_parts(
        Layout.of((grid,), p["feti"]), materials=(MATERIAL,), plane="strain",
        units=UNITS, names=NAMES, fixed=_supports(grid), load=_pressure(grid),
        pairs=(_on_rigid(grid),),
        linearise=lambda side, _: above_plane(
            side.mesh, side.pairs[0].slave, tangential=True
        ),
        laws=(FrictionLaw("coulomb", mu=p["mu"]),), glue=p["glue"],
        iterate=p["iterate"], results=results,
    )  # fmt: skip


def _grid(n: int) -> StructuredGrid:
    return rectangle_grid((0.0, 0.0), (SIDE, SIDE), (n, n))


def _pressure(grid: StructuredGrid) -> tuple[Nodes, Vector]:
    """Return the components on the top and the left, and the forces there, N/m."""
    component = dofs_of(grid.sides["top"], 2, 1), dofs_of(grid.sides["left"], 2, 0)
    force = (
        -TOP * nodal_lengths(grid.side("top")), LEFT * nodal_lengths(grid.side("left"))
    )  # fmt: skip
    return np.concatenate(component), np.concatenate(force)


def _supports(grid: StructuredGrid) -> Nodes:
    """Return the components that are held."""
    right, corner = grid.sides["right"], grid.sides["bottom"][-1]
    return np.append(dofs_of(right, 2, 0), dofs_of(corner, 2, 1))


def _on_rigid(grid: StructuredGrid) -> ContactPair:
    return ContactPair(grid.sides["bottom"][:-1], np.zeros(0, dtype=np.int64))


def along_the_side(
    bodies: Bodies | ContactSides, primal: QP, s: Solution, friction: Friction
) -> dict[str, Any]:
    """Report what was published; between nodes, by linear interpolation.

    displacement: u_x at `PLACES`, m. published_error: the largest relative distance
    from the published ones. normal_force: of the node at 38.75 mm, tangential_sum: of
    all nodes, N/m.
    """
    nodes = bodies.pairs[0].slave
    x, u = bodies.mesh.points[nodes, 0], s.x[dofs_of(nodes, 2, 0)] * bodies.length
    normal, tangential = np.split(s.z * bodies.force, [primal.h.size])
    at_places: Vector = np.interp(PLACES, x, u)
    return {
        "displacement": at_places.tolist(),
        "published_error": float(np.abs(at_places / PUBLISHED - 1).max()),
        "normal_force": float(np.interp(FORCE_AT, x, normal)),
        "tangential_sum": float(abs(tangential.sum())),
    }


@lru_cache(maxsize=2)
def _path(n: int, mu: float, reference: Reference) -> LoadPath:
    bodies = plate(n)
    rows = above_plane(bodies.mesh, bodies.pairs[0].slave, tangential=True)
    return LoadPath(
        bodies, lambda u: rows, lambda: clamped(bodies), reference, steps=1,
        laws=(FrictionLaw("coulomb", mu=mu),),
    )  # fmt: skip
