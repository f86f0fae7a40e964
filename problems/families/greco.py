"""GRECO's plate with Coulomb friction on a rigid plane (Code_Aster's SSNV128).

A square with sides of 40 mm in plane strain lies on the rigid plane y = 0 with friction
(μ = 1). Pressures act on the top and left sides, and the right side is supported in x:

    σ_y = −5e7 Pa at y = 40 mm,  σ_x = −15e7 Pa at x = 0,  u_x = 0 at x = 40 mm

with u_y = 0 at the corner (40 mm, 0), which has no contact row. The left end of the
contact side lifts off, the middle slips and the right end sticks. The published results
are the tangential displacements of five points of the contact side, ±5 %, and the
normal force at x = 38.75 mm for 32 cells per side (GRECO working group on friction; see
document V6.04.128 of Code_Aster).

In 3D (dim=3) the square is extruded along z into layers of cubes. The end faces have
u_z = 0; the solution in every layer of nodes is therefore that of plane strain.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from mortarbench.harness import QP, Friction, Solution, Vector
from mortarbench.harness.keys import Range
from mortarbench.problems.contact.bodies import (
    ContactPair,
    UnassembledBodies,
    structured,
)
from mortarbench.problems.contact.friction import FrictionLaw
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.rigid import RigidPlane
from mortarbench.problems.contact.rows import ContactRows
from mortarbench.problems.contact.stepping import load_steps
from mortarbench.problems.duality.problem import ContactProblem
from mortarbench.problems.families.contact import ContactFamily
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.mesh import (
    box,
    dofs_of,
    nodal_sizes,
    nodes_of_side,
    rectangle,
)
from mortarbench.problems.keys import (
    CONTACT_FORMS,
    MAX_SIZE,
    Dimension,
    Feti,
    Glue,
    check_memory,
    refuse_unused,
)

SIDE = 0.04  #: side length of the square, m
MATERIAL = Material(E=1.3e11, nu=0.2)
TOP, LEFT = 5e7, 15e7  #: pressures on the sides, Pa
FORCE = TOP * SIDE  #: unit of force F₀, N/m
#: positions x of the published points, m
PLACES = np.array([0.0, 1.25e-3, 5e-3, 7.5e-3, 11.25e-3])
#: published u_x at PLACES, m
PUBLISHED = np.array([2.86e-5, 2.72e-5, 2.28e-5, 1.98e-5, 1.50e-5])
FORCE_AT = 38.75e-3  #: position x of the published normal force, m


@dataclass(frozen=True, kw_only=True)
class Greco(ContactFamily):
    """GRECO's plate, pushed along a rigid plane with Coulomb friction (SSNV128)."""

    forms: ClassVar = CONTACT_FORMS

    n: Annotated[int, Range(2), "cells along each side"] = 32
    mu: Annotated[float, Range(0, MAX_SIZE), "coefficient of friction"] = 1.0
    feti: Feti = 0
    glue: Glue = "orthonormal"
    dim: Dimension = 2
    depth: Annotated[int, Range(1), "layers of cubes in 3D"] = 1

    def __post_init__(self) -> None:
        """Check the size and the dimension."""
        super().__post_init__()
        if self.dim == 2:
            refuse_unused(self, "depth", "dim=2", "dim=3")
        check_memory(self.n**2 if self.dim == 2 else 3 * self.n**2 * self.depth)

    def problem(self) -> ContactProblem:
        """Return the problem of the plate with n × n cells, or n × n × depth in 3D."""
        dim, n = self.dim, self.n
        none, thickness = np.zeros(0, dtype=np.int64), 1.0
        mesh = rectangle((0.0, 0.0), (SIDE, SIDE), (n, n))
        names, ends = ("bottom", "top"), none
        if dim == 3:
            thickness, names = SIDE * self.depth / n, ("front", "back")
            mesh = box((0.0,) * 3, (SIDE, SIDE, thickness), (n, n, self.depth))
            ends = np.unique([mesh.boundaries["bottom"], mesh.boundaries["top"]])
        sides, points, unit = mesh.boundaries, mesh.points, FORCE * thickness
        ground, right = sides[names[0]], nodes_of_side(sides["right"])
        top, top_shares = nodal_sizes(points, sides[names[1]])
        left, left_shares = nodal_sizes(points, sides["left"])
        f = np.zeros(mesh.dofs)
        f[dofs_of(top, dim, 1)] = -TOP * top_shares / unit
        f[dofs_of(left, dim, 0)] = LEFT * left_shares / unit
        fixed = np.concatenate(
            [
                dofs_of(right, dim, 0),
                dofs_of(np.intersect1d(ground, right), dim, 1),
                dofs_of(ends, dim, dim - 1),
            ]
        )
        if dim == 2:
            ground = ground[:-1]  # the corner has no contact row
        rigid = RigidPlane((0.0,) * dim, (0.0, 1.0, 0.0)[:dim])
        on_rigid = ContactPair(ground, ground[:0], rigid)
        return ContactProblem(
            bodies=UnassembledBodies(
                shape=structured(mesh),
                names=("plate",),
                materials=(MATERIAL,),
                plane="strain" if dim == 2 else None,
                length=SIDE,
                force=unit,
                fixed=fixed,
                f=f,
                pairs=(on_rigid,),
            ),
            stages=load_steps(1, 1, f, fixed, (FrictionLaw("coulomb", mu=self.mu),)),
            linearise=lambda bodies, laws: linearisation(bodies, "nts", "dual", laws),
            results=lambda answer: {
                **published_quantities(*answer.sides, thickness=thickness),
                "tresca_problems": answer.problems,
            },
        )


def published_quantities(
    bodies: UnassembledBodies,
    primal: QP,
    s: Solution,
    rows: ContactRows,
    friction: Friction,
    thickness: float,
) -> dict[str, Any]:
    """Return the published quantities, interpolated linearly between nodes.

    In 3D, displacements are means over z, and forces are sums over z divided by the
    thickness. The keys are `displacement`, u_x at `PLACES` in m; `published_error`, the
    largest relative deviation from the published values; `normal_force`, the nodal
    force at 38.75 mm in N/m; and `tangential_sum`, the magnitude of the total friction
    force in N/m.
    """
    dim, (pair,) = bodies.mesh.dim, bodies.pairs
    nodes = pair.slave_nodes[rows.place]  # nodes with contact rows
    x, column = np.unique(bodies.mesh.points[nodes, 0], return_inverse=True)
    u = s.x[dofs_of(nodes, dim, 0)] * bodies.length
    normal = np.bincount(column, s.z[: primal.h.size]) * bodies.force / thickness
    mean = np.bincount(column, u) / np.bincount(column)
    at_places: Vector = np.interp(PLACES, x, mean)
    force = friction.T.T @ s.z[primal.h.size :] * bodies.force / thickness
    return {
        "displacement": at_places.tolist(),
        "published_error": float(np.abs(at_places / PUBLISHED - 1).max()),
        "normal_force": float(np.interp(FORCE_AT, x, normal)),
        "tangential_sum": float(abs(force[dofs_of(nodes, dim, 0)].sum())),
    }
