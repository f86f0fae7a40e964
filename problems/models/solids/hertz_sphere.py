"""Elastic spheres in contact, and Hertz's exact solution.

A sphere is pressed onto a rigid plane, or onto an equal sphere. Each body is the part
of a sphere around the contact, a quarter of a block of half width and height EXTENT·a
with the sphere as its contact side. The planes x = 0 and y = 0 are planes of symmetry.
The tractions on its other sides are those of a point force P at the origin of a
half-space (Boussinesq; Johnson 1985, Section 3.2), from which those of Hertz's pressure
differ by O((a/ρ)²), relatively. A whole sphere is not suitable: its overall
compression, which the theory neglects, is of order a/R, 6 % of the approach at 0.08.

The upper body is supported by contact alone, so that the form ``dual-bounds`` does not
exist. A support of the lower one along z has no reaction. The displacement far from the
contact is that of the half-space minus the approach of distant points to the plane
z = 0. It is measured at the side opposite the contact, and summed over the bodies.

The meshes of two spheres do not match: the lower one has n + 1 cells per a. Contact is
linearised at the undeformed state, along normals that differ from the vertical by up to
a/R, which changes the results by O(a²/R²).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import InputError, Value, Vector
from mortarbench.problems.contact.bodies import ContactPair
from mortarbench.problems.contact.results import pair_results
from mortarbench.problems.contact.rigid import RigidPlane
from mortarbench.problems.contact.sides import contact_sides
from mortarbench.problems.contact.stepping import Forces, load_steps
from mortarbench.problems.duality.problem import (
    ContactProblem,
    ContactSolution,
    ElasticBodies,
    StructuredSolids,
    cached_problem,
    keyed_linearisation,
)
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.elements import QUAD
from mortarbench.problems.fem.mesh import (
    Mesh,
    Nodes,
    box_grid,
    dofs_of,
    nodal_areas,
    prefixed,
)
from mortarbench.problems.models.half_space.point_contact import PointContact
from mortarbench.problems.models.hertz import graded_points

#: size of the block over a; 6 and 10 change a and p₀ by 0.1 %
EXTENT = 4.0
UNIFORM = 1.25  #: half width of the uniformly meshed part, in a
#: largest a/R: the corner of the block is then at 0.71 R from the axis
MAX_RATIO = 1 / 8
GROUND = RigidPlane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
#: names of the bodies by the key `against`
NAMES: Mapping[str, tuple[str, ...]] = {
    "plane": ("sphere",), "sphere": ("upper", "lower"),
}  # fmt: skip


class _Block(NamedTuple):
    """A body between its contact side and the rest of its half space."""

    mesh: Mesh
    cells: tuple[int, int, int]
    up: int  #: 1 above the plane z = 0, −1 below

    @property
    def contact(self) -> Nodes:
        """Faces of the sphere."""
        return self.mesh.boundaries["bottom" if self.up > 0 else "top"]

    @property
    def opposite(self) -> Nodes:
        """Faces opposite the contact."""
        return self.mesh.boundaries["top" if self.up > 0 else "bottom"]


@cached_problem
def problem(params: Mapping[str, Value]) -> ContactProblem:
    """Return the spheres, with n cells per contact radius a.

    Raises
    ------
    InputError
        When the contact is too large for the theory.

    """
    p: Any = params
    material, exact = Material(E=p["E"], nu=p["nu"]), _exact(p)
    if exact.a > MAX_RATIO * p["R"]:
        raise InputError(
            f"hertz-sphere: the contact radius {exact.a:.4g} is more than R/8 = "
            f"{MAX_RATIO * p['R']:.4g}; expected a smaller load, or a larger E or R"
        )
    names = NAMES[p["against"]]
    blocks = [_block(exact.a, p["R"], p["n"] + k, 1 - 2 * k) for k in range(len(names))]
    shape = StructuredSolids(
        tuple(prefixed(b.mesh, name) for b, name in zip(blocks, names, strict=True)),
        tuple(b.cells for b in blocks),
    )
    first = np.cumsum([0, *(len(b.mesh.points) for b in blocks)])
    forces, fixed = [], []
    for block, start in zip(blocks, first, strict=False):
        loaded, force = _far_forces(block, material.nu)
        forces.append(Forces(dofs_of(loaded + start, 3), force.ravel()))
        for side, axis in (("left", 0), ("front", 1)):
            nodes = np.unique(block.mesh.boundaries[side])
            fixed.append(dofs_of(nodes + start, 3, axis))
    sides = [
        _near(block, UNIFORM * exact.a) + start
        for block, start in zip(blocks, first, strict=False)
    ]
    if p["against"] == "plane":
        pair = ContactPair(sides[0], sides[0][:0], GROUND)
    else:
        pair = ContactPair(*sides)
        below = blocks[1].opposite.min() + first[1]  # on the axis
        fixed.append(dofs_of(np.array([below]), 3, 2))
    held = np.concatenate(fixed)
    whole = Forces(*map(np.concatenate, zip(*forces, strict=True)))

    def results(solution: ContactSolution) -> dict[str, Any]:
        """Compare with Hertz; the approach is that of distant points, m."""
        approach = sum(
            _approach(block, solution, start, exact.P, material, p["R"])
            for block, start in zip(blocks, first, strict=False)
        )
        return {
            **_quantities(solution, exact),
            "approach": approach, "approach_error": approach / exact.approach - 1,
        }  # fmt: skip

    return ContactProblem(
        bodies=ElasticBodies(
            shape=shape, names=names, materials=(material,) * len(names), plane=None,
            length=p["R"], force=exact.P, fixed=held, forces=whole, pairs=(pair,),
        ),
        stages=load_steps(1, 1, whole, held),
        linearise=keyed_linearisation(p), results=results,
    )  # fmt: skip


def _exact(params: Mapping[str, Value]) -> PointContact:
    """Return Hertz's solution: 1/R and 1/E* are sums over the elastic bodies."""
    p: Any = params
    bodies = len(NAMES[p["against"]])
    modulus = p["E"] / (1 - p["nu"] ** 2)
    return PointContact(p["load"], p["R"] / bodies, modulus / bodies)


def _block(a: float, R: float, n: int, up: int) -> _Block:
    """Return a quarter of a block with n cells per a and a sphere about (0, 0, ±R)."""
    size = EXTENT * a
    x, z = graded_points(a / n, UNIFORM * a, size), graded_points(a / n, 0.0, size)
    grid = box_grid(x, x, z if up > 0 else -z[::-1])
    points = grid.points.copy()
    depth = R - np.sqrt(R**2 - (points[:, :2] ** 2).sum(axis=1))
    points[:, 2] += up * (1 - np.abs(points[:, 2]) / size) * depth
    cells = x.size - 1, x.size - 1, z.size - 1
    return _Block(Mesh(points, grid.cells, grid.boundaries), cells, up)


def _near(block: _Block, half_width: float) -> Nodes:
    """Return the faces of the sphere that may touch, within a half width.

    Those below the slave also contain the faces at the edge of this region.
    """
    reach = np.abs(block.mesh.points[block.contact][..., :2])
    within = reach <= half_width * (1 + 1e-9)
    corners = within.all(axis=1) if block.up > 0 else within.any(axis=1)
    return block.contact[corners.all(axis=1)]


def _far_forces(block: _Block, nu: float) -> tuple[Nodes, NDArray[np.float64]]:
    """Return the nodes (k,) of the far sides, and their forces (k, 3) for P = 1.

    These are the tractions of a unit point force on the half space. Their sum is a
    quarter of P, also with quadrature.
    """
    mesh, mirror = block.mesh, np.array([1, 1, block.up])
    forces = np.zeros_like(mesh.points)
    sides = mesh.boundaries["right"], mesh.boundaries["back"], block.opposite
    faces = np.concatenate(sides)
    corners = mesh.points[faces]
    for xi, weight in zip(QUAD.points, QUAD.weights, strict=True):
        N, slopes = QUAD.shapes(xi), QUAD.gradients(xi)
        normal = np.cross(*np.einsum("ar,fax->rfx", slopes, corners))  # times area
        stress = point_force_stress(mirror * np.einsum("a,fax->fx", N, corners), nu)
        traction = mirror * np.einsum("fij,fj->fi", stress, mirror * normal)
        np.add.at(forces, faces, weight * N[:, None] * traction[:, None])
    nodes = np.unique(faces)
    return nodes, forces[nodes] * (-block.up / (4 * forces[:, 2].sum()))


def _approach(
    block: _Block, solution: ContactSolution, start: int, P: float,
    material: Material, length: float,
) -> float:  # fmt: skip
    """Return the approach of distant points of a body to z = 0, m.

    It is the mean over the side opposite the contact.
    """
    nodes, shares = nodal_areas(block.mesh.points, block.opposite)
    # displacement under a point force on a half space, relative to distant points
    mirrored = block.mesh.points[nodes] * [1, 1, block.up]
    expected = P * _settlement(mirrored, material)
    u = solution.at(dofs_of(nodes + start, 3, 2)) * (block.up * length)
    return float(shares @ (expected - u) / shares.sum())


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
    bodies = solution.sides.bodies
    (side,) = contact_sides(*solution.sides)
    points, force = bodies.mesh.points[side.nodes], 4 * side.force[:, 2]
    a = np.sqrt(2.5 * (force @ (points[:, :2] ** 2).sum(axis=1)) / exact.P)
    total, largest = float(force.sum()), float((force / (4 * side.length)).max())
    ((name, pair),) = pair_results(*solution.sides).items()
    on_slave = [0.0, 0.0, total]
    forces = dict(zip(bodies.names, (on_slave, [0.0, 0.0, -total]), strict=False))
    pair |= {"force": forces, "pressed_area": 4 * pair["pressed_area"]}
    z = solution.sides.solution.z[: solution.sides.primal.h.size]
    return {
        # the force on the master, on the slave if the master is rigid
        "contact_force": list(forces.values())[-1],
        "multiplier_sum": float(4 * z.sum() * bodies.force),
        "contacts": {name: pair}, "force_error": total / exact.P - 1,
        "contact_radius": float(a), "contact_radius_error": float(a / exact.a - 1),
        "p_max": largest, "p_max_error": largest / exact.p0 - 1,
    }  # fmt: skip
