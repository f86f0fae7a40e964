"""GRECO's plate with Coulomb friction on a rigid plane (Code_Aster's SSNV128).

A square of 40 mm in plane strain lies on y = 0 with μ = 1. Pressures act on its top and
left sides, and its right side is supported in x:

    σ_y = −5e7 Pa at y = 40 mm,  σ_x = −15e7 Pa at x = 0,  u_x = 0 at x = 40 mm

with u_y = 0 at the corner (40 mm, 0), which has no contact row. The left end lifts off,
the middle slips and the right end sticks. Published are the tangential displacements of
five points of the contact side, ±5 %, and the normal force at 38.75 mm for 32 cells per
side (GRECO working group on friction; collected in Code_Aster's document V6.04.128).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mortarbench.harness import QP, Friction, Solution, Value, Vector
from mortarbench.problems.contact.bodies import Bodies, ContactPair, ContactSides
from mortarbench.problems.contact.friction import FrictionLaw
from mortarbench.problems.contact.rigid import RigidPlane, rigid_rows
from mortarbench.problems.contact.stepping import Forces, load_steps
from mortarbench.problems.duality.problem import (
    ContactProblem,
    ElasticBodies,
    StructuredGrids,
    cached_problem,
)
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.mesh import dofs_of, nodal_lengths, rectangle_grid

SIDE = 0.04  #: m
MATERIAL = Material(E=1.3e11, nu=0.2)
TOP, LEFT = 5e7, 15e7  #: pressures on the sides, Pa
FORCE = TOP * SIDE  #: F₀, N/m
GROUND = RigidPlane((0.0, 0.0), (0.0, 1.0))
PLACES = np.array([0.0, 1.25e-3, 5e-3, 7.5e-3, 11.25e-3])  #: x of published points, m
PUBLISHED = np.array([2.86e-5, 2.72e-5, 2.28e-5, 1.98e-5, 1.50e-5])  #: u_x there, m
FORCE_AT = 38.75e-3  #: x of the published normal force, m


@cached_problem
def problem(params: Mapping[str, Value]) -> ContactProblem:
    """Return the plate with n × n cells."""
    p: Any = params
    grid = rectangle_grid((0.0, 0.0), (SIDE, SIDE), (p["n"], p["n"]))
    sides = grid.sides
    forces = Forces(
        np.concatenate(
            [dofs_of(sides["top"], 2, 1), dofs_of(sides["left"], 2, 0)]
        ),
        np.concatenate([
            -TOP * nodal_lengths(grid.side("top")) / FORCE,
            LEFT * nodal_lengths(grid.side("left")) / FORCE,
        ]),
    )  # fmt: skip
    right, corner = sides["right"], sides["bottom"][-1]
    fixed = np.append(dofs_of(right, 2, 0), dofs_of(corner, 2, 1))
    on_rigid = ContactPair(sides["bottom"][:-1], np.zeros(0, dtype=np.int64))
    return ContactProblem(
        bodies=ElasticBodies(
            shape=StructuredGrids((grid,)), names=("plate",), materials=(MATERIAL,),
            plane="strain", length=SIDE, force=FORCE, fixed=fixed, forces=forces,
            pairs=(on_rigid,),
        ),
        stages=load_steps(1, 1, forces, fixed, (FrictionLaw("coulomb", mu=p["mu"]),)),
        linearise=lambda bodies, _: lambda u: rigid_rows(
            bodies.mesh.points, np.zeros_like(u), bodies.pairs[0].slave, GROUND,
            tangential=True,
        ),
        results=lambda answer: {
            **published_quantities(*answer.sides), "tresca_problems": answer.problems,
        },
    )  # fmt: skip


def published_quantities(
    bodies: Bodies | ContactSides, primal: QP, s: Solution, friction: Friction
) -> dict[str, Any]:
    """Return the published quantities, interpolated linearly between nodes.

    displacement: u_x at `PLACES`, m. published_error: the largest relative deviation
    from the published values. normal_force: nodal force at 38.75 mm, N/m.
    tangential_sum: magnitude of the sum over all nodes, N/m.
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
