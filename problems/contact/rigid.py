"""Contact of nodes with rigid bodies: planes, spheres and cylinders.

The gap g(x) of a point is its signed distance from the rigid body, and n is the outward
normal of the body at the closest point. To first order about the displacement u^k, with
x = X + u^k and n fixed there,

    g(x) + n·(u − u^k) ≥ 0    ⟺    B u ≤ c,    B = −n at the node,  c = g(x) − n·u^k

This linearisation is exact for planes. The nonzero entries of a row belong to a single
node; therefore, the contact rows of a pair are orthonormal. Friction rows are T = −t at
the node, with the tangents t.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mortarbench.harness import InputError, Vector
from mortarbench.problems.contact.rows import ContactRows, rows_along
from mortarbench.problems.contact.surface import (
    Points,
    current_positions,
    current_surface,
    tangents,
)
from mortarbench.problems.fem.mesh import Nodes, as_vectors, nodes_of_side


class RigidBody(Protocol):
    """A rigid body, described by its signed distance function (positive outside)."""

    def gap(self, x: Points) -> tuple[Vector, Points]:
        """Return signed distances (s,) of points (s, dim), and normals (s, dim)."""


@dataclass(frozen=True)
class RigidPlane:
    """A half space, bounded by a plane."""

    point: tuple[float, ...]  #: a point on the plane, m
    normal: tuple[float, ...]  #: outward unit normal

    def gap(self, x: Points) -> tuple[Vector, Points]:
        """Return signed distances (s,) of points (s, dim), and normals (s, dim)."""
        normal = np.array(self.normal)
        return (x - self.point) @ normal, np.broadcast_to(normal, x.shape)


@dataclass(frozen=True)
class RigidSphere:
    """A ball in 3D, or a disc in 2D."""

    centre: tuple[float, ...]  #: position of the centre, m
    radius: float  #: radius, m

    def gap(self, x: Points) -> tuple[Vector, Points]:
        """Return signed distances (s,) of points (s, dim), and normals (s, dim)."""
        return _gap_from_centre(x - self.centre, self.radius)


@dataclass(frozen=True)
class RigidCylinder:
    """An infinite circular cylinder in 3D."""

    point: tuple[float, ...]  #: a point on the axis, m
    axis: tuple[float, ...]  #: unit vector along the axis
    radius: float  #: radius, m

    def gap(self, x: Points) -> tuple[Vector, Points]:
        """Return signed distances (s,) of points (s, dim), and normals (s, dim)."""
        offset, axis = x - self.point, np.array(self.axis)
        return _gap_from_centre(offset - np.outer(offset @ axis, axis), self.radius)


def _gap_from_centre(offset: Points, radius: float) -> tuple[Vector, Points]:
    distance = np.linalg.norm(offset, axis=1)
    if not distance.all():
        raise InputError(
            "a contact node is at the centre of a rigid sphere or on the axis of a "
            "rigid cylinder; expected nodes near the surface"
        )
    return distance - radius, offset / distance[:, None]


def rigid_rows(
    points: Points,
    u: Vector,
    side: Nodes,
    rigid: RigidBody,
    *,
    tangential: bool = False,
) -> ContactRows:
    """Return the contact rows of a side against a rigid body, linearised at u.

    Parameters
    ----------
    points : (N, dim) reference positions X, m
    u : (n,) displacement u^k at which to linearise, m
    side : nodes or faces of the side, a boundary of a `Mesh`
    tangential : add tangential rows for friction

    Raises
    ------
    InputError
        If a position is not finite, at the centre of a sphere, or on the axis of a
        cylinder.

    """
    dim, nodes = points.shape[1], nodes_of_side(side)
    gap, normal = rigid.gap(current_positions(points, u, nodes, "slave"))
    node, every, one = nodes[:, None], np.arange(nodes.size), np.ones((nodes.size, 1))
    along = tangents(normal)[: nodes.size if tangential else 0]
    row = np.repeat(np.arange(len(along)), dim - 1)
    reference = current_surface(points, np.zeros_like(u), side, "slave")
    return ContactRows(
        B=rows_along(node, -one, normal, points.size),
        c=gap - np.einsum("sx,sx->s", normal, as_vectors(u, dim)[nodes]),
        T=rows_along(node[row], -one[row], along.reshape(-1, dim), points.size),
        row=row,
        share=reference.areas,
        place=every,
        covered=np.ones(nodes.size),
        at=every,
    )
