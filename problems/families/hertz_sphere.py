"""Elastic spheres in contact, and Hertz's exact solution.

A sphere is pressed onto a rigid plane, or onto an equal sphere. Each body is the part
of a sphere near the contact: a block whose half width and height are EXTENT·a, and
whose contact side is part of the surface of the sphere. Since x = 0 and y = 0 are
planes of symmetry, a quarter of the block is meshed. The tractions on the other sides
are those of a point force P at the origin of a half-space (Boussinesq; Johnson 1985,
Section 3.2). At the distance ρ from the origin, their relative difference from the
tractions of Hertz's pressure is O((a/ρ)²). A whole sphere is not suitable, because its
overall compression, which the theory neglects, is of order a/R relative to the
approach, 6 % for a/R = 0.08.

The upper body is supported by contact alone; therefore, the form ``dual-bounds`` does
not exist. A support of the lower body along z has no reaction. The displacement far
from the contact is that of the half-space minus the approach of distant points to the
plane z = 0. The approach is evaluated at the side opposite the contact and summed over
the bodies.

In Cattaneo and Mindlin's problem, a tangential force Q acts along x on two blocks of
double width, for which only y = 0 is a plane of symmetry. The tractions of Q on the cut
faces are those of a tangential point force (Cerruti; Johnson, Section 3.6). P acts
first, without friction, then Q with Coulomb's law; slip is measured from the state
under P.

The meshes of two spheres do not match: the lower one has n + 1 cells per a. Contact is
linearised at the undeformed state, along normals that differ from the vertical by up to
a/R, which changes the results by O(a²/R²).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import InputError, Vector
from mortarbench.harness.keys import Range
from mortarbench.problems.contact.bodies import (
    ContactPair,
    UnassembledBodies,
    structured,
)
from mortarbench.problems.contact.friction import FrictionLaw
from mortarbench.problems.contact.results import pair_results
from mortarbench.problems.contact.rigid import RigidPlane
from mortarbench.problems.contact.sides import contact_sides
from mortarbench.problems.contact.stepping import load_steps, normal_first
from mortarbench.problems.duality.problem import (
    ContactProblem,
    ContactSolution,
    keyed_linearisation,
)
from mortarbench.problems.families.contact import ContactFamily
from mortarbench.problems.families.half_space.point_contact import (
    PointContact,
    ShearedPointContact,
)
from mortarbench.problems.families.hertz import graded_points
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
from mortarbench.problems.keys import (
    POSITIVE,
    Basis,
    Feti,
    Glue,
    Method,
    check_memory,
    check_tangential,
    refuse_unused,
)

#: half width and height of the block in units of a; values of 6 and 10 change the
#: computed contact radius and p₀ by 0.1 %
EXTENT = 4.0
UNIFORM = 1.25  #: half width of the uniformly meshed part, in units of a
#: largest accepted a/R; at this value, the corner of the block is at a distance of 0.71
#: R from the axis
MAX_RATIO = 1 / 8
GROUND = RigidPlane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
#: mapping from the value of the key `against` to the names of the bodies
NAMES: Mapping[str, tuple[str, ...]] = {
    "plane": ("sphere",),
    "sphere": ("upper", "lower"),
}


class _Block(NamedTuple):
    """A block cut from a half space around the contact."""

    mesh: Mesh
    up: int  #: 1 for a block above the plane z = 0, −1 for one below
    copies: int  #: number of blocks around the axis: 4, or 2 of double width

    @property
    def contact(self) -> Nodes:
        """Faces on the sphere, the contact side."""
        return self.mesh.boundaries["bottom" if self.up > 0 else "top"]

    @property
    def opposite(self) -> Nodes:
        """Faces opposite the contact."""
        return self.mesh.boundaries["top" if self.up > 0 else "bottom"]

    @property
    def far(self) -> Nodes:
        """Faces on which the rest of the half space acts."""
        names = ("right", "back") if self.copies == 4 else ("right", "back", "left")
        sides = [self.mesh.boundaries[name] for name in names]
        return np.concatenate([*sides, self.opposite])

    @property
    def symmetric(self) -> Nodes:
        """Components that vanish on planes of symmetry."""
        planes = (("front", 1), ("left", 0))[: 2 if self.copies == 4 else 1]
        return np.concatenate(
            [dofs_of(np.unique(self.mesh.boundaries[k]), 3, axis) for k, axis in planes]
        )

    @property
    def axis(self) -> Nodes:
        """Nodes on the axis, from bottom to top."""
        return np.flatnonzero((self.mesh.points[:, :2] == 0).all(axis=1))


@dataclass(frozen=True, kw_only=True)
class HertzSphere(ContactFamily):
    """Hertzian point contact: an elastic sphere on a rigid plane or an equal sphere."""

    forms: ClassVar = ("primal", "dual")

    n: Annotated[int, Range(1), "cells per contact radius"] = 8
    against: Annotated[Literal["plane", "sphere"], "a rigid plane, or a sphere"] = (
        "plane"
    )
    R: Annotated[float, POSITIVE, "radius of a sphere, m"] = 8.0
    E: Annotated[float, POSITIVE, "Young's modulus, Pa"] = 200.0
    nu: Annotated[float, Range(-1, 0.5), "Poisson's ratio, between -1 and 0.5"] = 0.3
    load: Annotated[float, POSITIVE, "force P, N"] = 10.0
    Q: Annotated[float, "tangential force on a sphere, a fraction of μP"] = 0.0
    mu: Annotated[float, POSITIVE, "coefficient of friction under Q"] = 0.3
    contact: Method = "mortar"
    basis: Basis = "dual"
    feti: Feti = 0
    glue: Glue = "orthonormal"

    def __post_init__(self) -> None:
        """Check that every key is used, and that the mesh fits into memory."""
        super().__post_init__()
        check_memory(3 * self.n**3)
        if self.against == "plane":
            for name in ("contact", "basis"):
                refuse_unused(self, name, "against=plane", "against=sphere")
        if self.Q:
            check_tangential(self.Q)
        if self.Q and self.against == "plane":
            raise InputError(
                f"Q={self.Q} is not supported with against=plane; expected "
                "against=sphere, for which the exact solution is known"
            )
        if not self.Q:
            refuse_unused(self, "mu", "Q=0", "a tangential force Q")
        if self.nu in (-1, 0.5):
            raise InputError(f"nu={self.nu} must be between -1 and 0.5, exclusively")

    def exact(self) -> PointContact:
        """Return Hertz's solution, with 1/R and 1/E* summed over the elastic bodies."""
        bodies = len(NAMES[self.against])
        modulus = self.E / (1 - self.nu**2)
        return PointContact(self.load, self.R / bodies, modulus / bodies)

    def problem(self) -> ContactProblem:
        """Return the contact problem of the spheres, with n cells per contact radius a.

        Raises
        ------
        InputError
            If the contact radius is too large for the theory.

        """
        material, exact = Material(E=self.E, nu=self.nu), self.exact()
        if exact.a > MAX_RATIO * self.R:
            raise InputError(
                f"the contact radius {exact.a:.4g} is more than R/8 = "
                f"{MAX_RATIO * self.R:.4g}; expected a smaller load, or a larger E or R"
            )
        names, copies = NAMES[self.against], 2 if self.Q else 4
        blocks = [
            _block(exact.a, self.R, self.n + k, 1 - 2 * k, copies)
            for k in range(len(names))
        ]
        first = np.cumsum([0, *(len(b.mesh.points) for b in blocks)])
        parts = list(zip(blocks, first.tolist(), strict=False))
        sides = [_near(block, UNIFORM * exact.a) + start for block, start in parts]
        fixed = [block.symmetric + 3 * start for block, start in parts]
        pair = ContactPair(sides[0], sides[0][:0], GROUND)
        if len(blocks) == 2:
            pair = ContactPair(*sides)
            # supports of the lower block, which have no reactions: they prevent motion
            # along z, and for a block of double width also along x and about y
            axis = blocks[1].axis + first[1]
            fixed.append(dofs_of(axis[:1], 3, 2))
            if self.Q:
                fixed.append(dofs_of(axis[[0, -1]], 3, 0))
        held = np.concatenate(fixed)
        normal = partial(point_force_stress, nu=self.nu)
        f = pressing = np.concatenate([_far_forces(b, normal, 2) for b in blocks])
        stages = load_steps(1, 1, f, held)
        if self.Q:
            tangential = partial(tangential_force_stress, nu=self.nu)
            shearing = [_far_forces(b, tangential, 0) for b in blocks]
            f = pressing + self.Q * self.mu * np.concatenate(shearing)
            # supports that prevent sliding and rolling; by symmetry they have no
            # reactions
            upright = dofs_of(blocks[0].axis[[0, -1]], 3, 0)
            law = FrictionLaw("coulomb", mu=self.mu)
            stages = normal_first(pressing, f, held, upright, law)

        def results(solution: ContactSolution) -> dict[str, Any]:
            """Compare with the exact solution; `approach` is of distant points, m."""
            approach = sum(
                _approach(block, solution, start, exact.P, material, self.R)
                for block, start in parts
            )
            values = _quantities(solution, exact, copies)
            if self.Q:
                sheared = ShearedPointContact(exact, self.mu, self.nu, self.Q)
                values |= _shear_quantities(solution, sheared, copies)
            return {
                **values,
                "approach": approach,
                "approach_error": approach / exact.approach - 1,
            }

        meshes = (prefixed(b.mesh, k) for b, k in zip(blocks, names, strict=True))
        return ContactProblem(
            bodies=UnassembledBodies(
                shape=structured(*meshes),
                names=names,
                materials=(material,) * len(names),
                plane=None,
                length=self.R,
                force=exact.P,
                fixed=held,
                f=f,
                pairs=(pair,),
            ),
            stages=stages,
            linearise=keyed_linearisation(self.contact, self.basis, undeformed=True),
            results=results,
        )


def _block(a: float, R: float, n: int, up: int, copies: int) -> _Block:
    """Return a block with n cells per a and a sphere about (0, 0, ±R)."""
    size = EXTENT * a
    y, z = graded_points(a / n, UNIFORM * a, size), graded_points(a / n, 0.0, size)
    x = y if copies == 4 else np.append(-y[:0:-1], y)
    grid = box_grid(x, y, z if up > 0 else -z[::-1])
    points = grid.points.copy()
    depth = R - np.sqrt(R**2 - (points[:, :2] ** 2).sum(axis=1))
    points[:, 2] += up * (1 - np.abs(points[:, 2]) / size) * depth
    return _Block(replace(grid, points=points), up, copies)


def _near(block: _Block, half_width: float) -> Nodes:
    """Return the contact faces whose nodes all have |x|, |y| ≤ half_width.

    On the lower body, faces with only some of their nodes in this region are included.
    """
    reach = np.abs(block.mesh.points[block.contact][..., :2])
    within = reach <= half_width * (1 + 1e-9)
    along: NDArray[np.bool_] = (np.all if block.up > 0 else np.any)(within, axis=1)
    return block.contact[along.all(axis=1)]


def _far_forces(
    block: _Block,
    stress: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    axis: int,
) -> Vector:
    """Return the nodal forces of the rest of the half space that balance a point force.

    The point force on the block at the origin is a unit force along z, away from the
    contact, or along x (towards −x on the upper block). The forces on the far sides
    follow from the tractions of the stress due to the point force. These forces are
    scaled, and for a point force along x, forces along z are added on the side opposite
    the contact, so that the resultant and the moment about y vanish despite quadrature
    errors and the curved side.

    stress : function that returns the stress (k, 3, 3) at points (k, 3) for the unit
        force
    axis : axis of the point force, 0 (x) or 2 (z)
    """
    mesh, mirror = block.mesh, np.array([1, 1, block.up])
    forces, faces = np.zeros_like(mesh.points), block.far
    corners = mesh.points[faces]
    for xi, weight in zip(QUAD.points, QUAD.weights, strict=True):
        N, slopes = QUAD.shapes(xi), QUAD.gradients(xi)
        # normal vectors with the length of the surface element
        normal = np.cross(*np.einsum("ar,fax->rfx", slopes, corners))
        at = mirror * np.einsum("a,fax->fx", N, corners)
        traction = mirror * np.einsum("fij,fj->fi", stress(at), mirror * normal)
        np.add.at(forces, faces, weight * N[:, None] * traction[:, None])
    total = -block.up if axis == 2 else block.up
    forces *= total / (block.copies * forces[:, axis].sum())
    if axis == 0:
        nodes, shares = nodal_areas(mesh.points, block.opposite)
        x, z = mesh.points[:, 0], mesh.points[:, 2]
        moment = z @ forces[:, 0] - x @ forces[:, 2]
        forces[nodes, 2] += moment * shares * x[nodes] / (shares @ x[nodes] ** 2)
    return forces.ravel()


def _approach(
    block: _Block,
    solution: ContactSolution,
    start: int,
    P: float,
    material: Material,
    length: float,
) -> float:
    """Return the approach of distant points of a body to the plane z = 0, m.

    The approach is averaged over the side opposite the contact.
    """
    nodes, shares = nodal_areas(block.mesh.points, block.opposite)
    # displacement under a point force on a half space, relative to distant points
    mirrored = block.mesh.points[nodes] * [1, 1, block.up]
    expected = P * _settlement(mirrored, material)
    u = solution.at(dofs_of(nodes + start, 3, 2)) * (block.up * length)
    return float(shares @ (expected - u) / shares.sum())


def point_force_stress(x: NDArray[np.float64], nu: float) -> NDArray[np.float64]:
    """Return the stress (k, 3, 3) at x (k, 3) under a unit force along z at the origin.

    The half space is z ≥ 0, and no point x may be on the z axis (Johnson, eq. (3.19)).
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


def tangential_force_stress(x: NDArray[np.float64], nu: float) -> NDArray[np.float64]:
    """Return the stress (k, 3, 3) at x (k, 3) under a unit force along x at the origin.

    The half space is z ≥ 0 (Cerruti; Johnson, eqs. (3.75) and (3.76)).
    """
    (X, Y, z), rho = x.T, np.linalg.norm(x, axis=1)
    s = rho + z
    near = (1 - 2 * nu) / rho
    # factor of X³, XY² and X²Y in the terms that vanish for ν = ½
    curved = 1 / (rho**2 * s**2) + 2 / (rho * s**3)
    xx = -3 * X**3 / rho**5 + near * X * (1 / rho**2 - 3 / s**2 + X**2 * curved)
    yy = -3 * X * Y**2 / rho**5 + near * X * (1 / rho**2 - 1 / s**2 + Y**2 * curved)
    xy = -3 * X**2 * Y / rho**5 + near * Y * (-1 / s**2 + X**2 * curved)
    zz, yz, xz = (-3 * X * z * k / rho**5 for k in (z, Y, X))
    rows = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return np.asarray(np.moveaxis(rows, -1, 0) / (2 * np.pi))


def _settlement(x: NDArray[np.float64], material: Material) -> Vector:
    """Return u_z (k,) at x under a unit point force along z at the origin, m/N."""
    rho = np.linalg.norm(x, axis=1)
    factor = (1 + material.nu) / (2 * np.pi * material.E)
    return np.asarray(factor * (x[:, 2] ** 2 / rho**3 + 2 * (1 - material.nu) / rho))


def _quantities(
    solution: ContactSolution, exact: PointContact, copies: int
) -> dict[str, Any]:
    """Compare with Hertz's pressure; forces and areas are those of full spheres.

    `contact_radius` is √(5∫pr²dA/2P) in m, which is exact for Hertz's pressure. Errors
    are relative.

    copies : number of blocks that form a sphere, by symmetry
    """
    bodies, primal, s, _, _ = solution.sides
    (side,) = contact_sides(*solution.sides)
    points, force = bodies.mesh.points[side.nodes], copies * side.force
    normal = force[:, 2]
    a = np.sqrt(2.5 * (normal @ (points[:, :2] ** 2).sum(axis=1)) / exact.P)
    # normal to planes of symmetry, the forces on mirror-image blocks cancel
    on_slave = force.sum(axis=0) * [copies == 2, 0, 1] + 0.0
    largest = float((normal / (copies * side.length)).max())
    both = on_slave.tolist(), (0.0 - on_slave).tolist()
    forces = dict(zip(bodies.names, both, strict=False))
    ((name, pair),) = pair_results(*solution.sides).items()
    pair |= {"force": forces, "pressed_area": copies * pair["pressed_area"]}
    if side.friction_force is not None:
        friction = copies * side.friction_force.sum(axis=0) * [1, 0, 1] + 0.0
        pair["friction_force"] = friction.tolist()
    return {
        # force on the master, or on the slave if the master is rigid
        "contact_force": list(forces.values())[-1],
        "multiplier_sum": float(copies * s.z[: primal.h.size].sum() * bodies.force),
        "contacts": {name: pair},
        "force_error": float(on_slave[2] / exact.P - 1),
        "contact_radius": float(a),
        "contact_radius_error": float(a / exact.a - 1),
        "p_max": largest,
        "p_max_error": largest / exact.p0 - 1,
    }


def _shear_quantities(
    solution: ContactSolution, exact: ShearedPointContact, copies: int
) -> dict[str, Any]:
    """Compare stick zone and tangential force of full spheres with the exact solution.

    `tangential_force` is the force along x on the lower sphere in N. `stick_area` is
    the sum of the nodal areas of sticking nodes in m². `stick_radius` is √(5∫sr²dA/2∫s
    dA) in m, with s = μp − q at sticking nodes. This radius is exact for Cattaneo and
    Mindlin's traction q, because s is then distributed like Hertz's pressure on a disc
    of radius c. `c_over_a` is the stick radius divided by the exact contact radius.
    `c_over_a_moment` follows from ∫qr²dA = ⅖μPa²(1 − (c/a)⁵), which also holds for
    Cattaneo and Mindlin's q.
    """
    (side,) = contact_sides(*solution.sides)
    assert side.friction_force is not None
    assert side.push is not None
    sticks = np.asarray(side.friction == "stick")
    total = -copies * side.force[:, 0].sum()
    limit, a = exact.mu * exact.normal.P, exact.normal.a
    r2 = (solution.sides.bodies.mesh.points[side.nodes, :2] ** 2).sum(axis=1)
    unused = exact.mu * side.push - np.linalg.norm(side.friction_force, axis=1)
    radius = (
        np.sqrt(2.5 * (unused @ (sticks * r2)) / (unused @ sticks))
        if sticks.any()
        else 0.0
    )
    moment = -copies * (side.friction_force[:, 0] @ r2) / (0.4 * limit * a**2)
    return {
        "tangential_force": float(total),
        "tangential_force_error": float(total / (exact.Q * limit) - 1),
        "stick_area": float(copies * side.length[sticks].sum()),
        "stick_radius": float(radius),
        "c_over_a": float(radius / a),
        "c_over_a_error": float(radius / exact.c - 1),
        "c_over_a_moment": float(max(1 - moment, 0.0) ** 0.2),
    }
