"""A cube of hexahedra next to a rigid wall: PERMON's example of contact in 3D.

The unit cube with E = 2e4 Pa and ν = 0.33 is clamped on z = 0 and loaded by a pressure
of 465 Pa on its top. The cube bulges towards the wall, which enforces u_x ≤ 1 mm on
x = 1. Contact rows are simple bounds and require no linearisation. Clamped nodes have
no contact row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from mortarbench.harness.keys import Range
from mortarbench.problems.contact.bodies import (
    ContactPair,
    UnassembledBodies,
    structured,
)
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.rigid import RigidPlane
from mortarbench.problems.contact.stepping import load_steps
from mortarbench.problems.duality.problem import (
    ContactProblem,
    ContactSolution,
)
from mortarbench.problems.families.contact import ContactFamily
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.mesh import box, dofs_of, nodal_areas
from mortarbench.problems.keys import CONTACT_FORMS, Feti, Glue, check_memory

MATERIAL = Material(E=2e4, nu=0.33)
SIDE = 1.0  #: side length of the cube, m
PRESSURE = 465.0  #: pressure on the top, Pa
GAP = 1e-3  #: gap between cube and wall, m
FORCE = PRESSURE * SIDE**2  #: unit of force F₀, N
WALL = RigidPlane((SIDE + GAP, 0.0, 0.0), (-1.0, 0.0, 0.0))


@dataclass(frozen=True, kw_only=True)
class CubeWall(ContactFamily):
    """A three-dimensional elastic cube, pressed down next to a rigid wall (PERMON)."""

    forms: ClassVar = CONTACT_FORMS

    n: Annotated[int, Range(1), "cells along each edge"] = 8
    feti: Feti = 0
    glue: Glue = "orthonormal"

    def __post_init__(self) -> None:
        """Check that the cube fits into memory."""
        super().__post_init__()
        check_memory(3 * self.n**3)

    def problem(self) -> ContactProblem:
        """Return the contact problem of the cube with n × n × n cells."""
        mesh = box((0.0,) * 3, (SIDE,) * 3, (self.n,) * 3)
        sides, f = mesh.boundaries, np.zeros(mesh.dofs)
        top, areas = nodal_areas(mesh.points, sides["top"])
        f[dofs_of(top, 3, 2)] = -PRESSURE * areas / FORCE
        right, bottom = sides["right"], np.unique(sides["bottom"])
        fixed = dofs_of(bottom, 3)
        corner = dofs_of(np.array([len(mesh.points) - 1]), 3)

        def results(solution: ContactSolution) -> dict[str, Any]:
            """Return the displacement of the corner (1, 1, 1), m."""
            return {"corner": (solution.at(corner) * SIDE).tolist()}

        return ContactProblem(
            bodies=UnassembledBodies(
                shape=structured(mesh),
                names=("cube",),
                materials=(MATERIAL,),
                plane=None,
                length=SIDE,
                force=FORCE,
                fixed=fixed,
                f=f,
                pairs=(ContactPair(right, right[:0], WALL),),
            ),
            stages=load_steps(1, 1, f, fixed),
            linearise=lambda bodies, _: linearisation(bodies, "nts", "dual"),
            results=results,
        )
