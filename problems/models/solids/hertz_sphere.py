"""An elastic sphere pressed onto a rigid plane, and Hertz's exact solution.

The body is the part of the sphere around the contact, a quarter of a block of half
width and height EXTENT·a with the sphere as its lower side. The planes x = 0 and y = 0
are planes of symmetry. The tractions on its other sides are those of a point force P at
the origin of a half-space (Boussinesq; Johnson 1985, Section 3.2), from which those of
Hertz's pressure differ by O((a/ρ)²), relatively. A whole sphere is not suitable: its
overall compression, which the theory neglects, is of order a/R, 6 % of the approach at
0.08.

The body is supported by contact alone, so that the form ``dual-bounds`` does not exist.
The displacement far from the contact is that of the half-space minus the approach δ of
distant points, which is measured at the top.

Errors at R = 8, E = 200, ν = 0.3, P = 10: 0.1 % in a and p₀ and 0.3 % in δ with 8 cells
per a.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import InputError, Value, Vector
from mortarbench.problems.contact.bodies import ContactPair
from mortarbench.problems.contact.results import pair_results
from mortarbench.problems.contact.rigid import RigidPlane, rigid_rows
from mortarbench.problems.contact.stepping import Forces, load_steps
from mortarbench.problems.duality.problem import (
    ContactProblem,
    ContactSolution,
    ElasticBodies,
    StructuredSolids,
    cached_problem,
)
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.elements import QUAD
from mortarbench.problems.fem.mesh import Mesh, box_grid, dofs_of, nodal_areas
from mortarbench.problems.models.half_space.point_contact import PointContact
from mortarbench.problems.models.hertz import graded_points

#: size of the block over a; 6 and 10 change a and p₀ by 0.1 %
EXTENT = 4.0
UNIFORM = 1.25  #: half width of the uniformly meshed part, in a
#: largest a/R: the corner of the block is then at 0.71 R from the axis
MAX_RATIO = 1 / 8
GROUND = RigidPlane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


@cached_problem
def problem(params: Mapping[str, Value]) -> ContactProblem:
    """Return the sphere on a plane, with n cells per contact radius a.

    Raises
    ------
    InputError
        When the contact is too large for the theory.

    """
    p: Any = params
    material = Material(E=p["E"], nu=p["nu"])
    exact = PointContact(p["load"], p["R"], p["E"] / (1 - p["nu"] ** 2))
    if exact.a > MAX_RATIO * exact.R:
        raise InputError(
            f"hertz-sphere: the contact radius {exact.a:.4g} is more than R/8 = "
            f"{MAX_RATIO * exact.R:.4g}; expected a smaller load, or a larger E or R"
        )
    shape = _block(exact, p["n"])
    mesh, sides = shape.mesh, shape.sides
    loaded = np.unique(np.concatenate([sides[name] for name in _CUT]))
    forces = _far_forces(mesh, material.nu)[loaded]
    forces /= -4 * forces[:, 2].sum()  # the quarter of P, also with quadrature
    symmetric = (("left", 0), ("front", 1))
    fixed = np.concatenate(
        [dofs_of(np.unique(sides[name]), 3, axis) for name, axis in symmetric]
    )
    half_width = UNIFORM * exact.a + 1e-9 * exact.R
    near = mesh.points[sides["bottom"]][..., :2] <= half_width
    slave = sides["bottom"][near.all(axis=(1, 2))]
    top, shares = nodal_areas(mesh.points, sides["top"])
    # where a point force on a half space moves the top, relative to distant points
    moved = exact.P * _settlement(mesh.points[top], material)

    def results(solution: ContactSolution) -> dict[str, Any]:
        u = solution.at(dofs_of(top, 3, 2)) * exact.R
        approach = float(shares @ (moved - u) / shares.sum())
        return {
            **_quantities(solution, exact),
            "approach": approach, "approach_error": approach / exact.approach - 1,
        }  # fmt: skip

    whole = Forces(dofs_of(loaded, 3), forces.ravel())
    return ContactProblem(
        bodies=ElasticBodies(
            shape=shape, names=("sphere",), materials=(material,), plane=None,
            length=exact.R, force=exact.P, fixed=fixed, forces=whole,
            pairs=(ContactPair(slave, np.zeros((0, 4), dtype=np.int64)),),
        ),
        stages=load_steps(1, 1, whole, fixed),
        linearise=lambda bodies, _: lambda u: rigid_rows(
            bodies.mesh.points, np.zeros_like(u), bodies.pairs[0].slave, GROUND
        ),
        results=results,
    )  # fmt: skip


_CUT = ("right", "back", "top")  #: sides on which the rest of the half space acts


def _block(exact: PointContact, n: int) -> StructuredSolids:
    """Return a quarter of the block, whose lower side is the sphere about (0, 0, R)."""
    size, h = EXTENT * exact.a, exact.a / n
    x, z = graded_points(h, UNIFORM * exact.a, size), graded_points(h, 0.0, size)
    grid = box_grid(x, x, z)
    points = grid.points.copy()
    depth = exact.R - np.sqrt(exact.R**2 - (points[:, :2] ** 2).sum(axis=1))
    points[:, 2] += (1 - points[:, 2] / size) * depth
    cells = x.size - 1, x.size - 1, z.size - 1
    mesh = Mesh(points, grid.cells, grid.boundaries)
    return StructuredSolids((mesh,), (cells,))


def _far_forces(mesh: Mesh, nu: float) -> NDArray[np.float64]:
    """Return the nodal forces (N, 3) of a unit point force on the sides `_CUT`."""
    forces = np.zeros_like(mesh.points)
    faces = np.concatenate([mesh.boundaries[name] for name in _CUT])
    corners = mesh.points[faces]
    for xi, weight in zip(QUAD.points, QUAD.weights, strict=True):
        N, slopes = QUAD.shapes(xi), QUAD.gradients(xi)
        normal = np.cross(*np.einsum("ar,fax->rfx", slopes, corners))  # times area
        stress = point_force_stress(np.einsum("a,fax->fx", N, corners), nu)
        traction = np.einsum("fij,fj->fi", stress, normal)
        np.add.at(forces, faces, weight * N[:, None] * traction[:, None])
    return forces


def point_force_stress(x: NDArray[np.float64], nu: float) -> NDArray[np.float64]:
    """Return the stress (k, 3, 3) at x (k, 3) under a unit force along z at the origin.

    The half space is z ≥ 0, and x are not on its surface's axis (Johnson, 3.19).
    """
    r, z, rho = np.hypot(x[:, 0], x[:, 1]), x[:, 2], np.linalg.norm(x, axis=1)
    radial = x * [1, 1, 0] / r[:, None]
    axial = np.broadcast_to([0.0, 0.0, 1.0], x.shape)
    around = np.cross(axial, radial)
    lateral = (1 - 2 * nu) / (rho * (rho + z))
    parts = (
        (lateral - 3 * r**2 * z / rho**5, radial, radial),
        ((1 - 2 * nu) * z / rho**3 - lateral, around, around),
        (-3 * z**3 / rho**5, axial, axial),
        (-3 * r * z**2 / rho**5, radial, axial),
        (-3 * r * z**2 / rho**5, axial, radial),
    )
    terms = [np.einsum("k,ki,kj->kij", value, a, b) for value, a, b in parts]
    return np.asarray(np.sum(terms, axis=0) / (2 * np.pi))


def _settlement(x: NDArray[np.float64], material: Material) -> Vector:
    """Return u_z (k,) under a unit point force, m/N; see `point_force_stress`."""
    rho = np.linalg.norm(x, axis=1)
    factor = (1 + material.nu) / (2 * np.pi * material.E)
    return np.asarray(factor * (x[:, 2] ** 2 / rho**3 + 2 * (1 - material.nu) / rho))


def _quantities(solution: ContactSolution, exact: PointContact) -> dict[str, Any]:
    """Compare the pressure with Hertz's; forces and areas are of the full sphere.

    contact_radius: √(5∫pr²dA/2P), exact for Hertz's pressure, m. Errors are relative.
    """
    bodies, primal, s, _ = solution.sides
    nodes, areas = nodal_areas(bodies.mesh.points, bodies.pairs[0].slave)
    force = 4 * s.z[: primal.h.size] * bodies.force
    r2 = (bodies.mesh.points[nodes, :2] ** 2).sum(axis=1)
    a, total = np.sqrt(2.5 * (force @ r2) / exact.P), float(force.sum())
    largest = float((force / (4 * areas)).max())
    ((name, pair),) = pair_results(*solution.sides).items()
    pair |= {
        "force": {bodies.names[0]: [0.0, 0.0, total]},
        "pressed_area": 4 * pair["pressed_area"],
    }
    return {
        "contact_force": [0.0, 0.0, total], "multiplier_sum": total,
        "contacts": {name: pair}, "force_error": total / exact.P - 1,
        "contact_radius": float(a), "contact_radius_error": float(a / exact.a - 1),
        "p_max": largest, "p_max_error": largest / exact.p0 - 1,
    }  # fmt: skip
