"""Contact sides in space: faces, their triangles, normals and nodal areas.

A quadrilateral face is four triangles about the mean of its corners. Its shape
functions are linear on each of them, with the value ¼ at the centre; so the surface is
continuous, and integrals over overlaps of two sides are exact.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import InputError, Vector
from mortarbench.problems.contact.surface import Points, unit
from mortarbench.problems.fem.mesh import Nodes


class Faces(NamedTuple):
    """Faces of one side at the current positions, with their triangles."""

    x: Points  #: (v, 3) nodes of the side, m
    corners: Nodes  #: (f, c) nodes of each face, places in x; triangles repeat the last
    centre: Points  #: (f, 3) means of the corners
    normal: Points  #: (f, 3) outward unit normals
    radius: Vector  #: (f,) largest distance of a corner from the centre, m
    face: Nodes  #: (t,) face of each triangle, ascending
    shape: NDArray[np.float64]  #: (t, 3, c) shape functions of the face at its vertices

    vertices: Points  #: (t, 3, 3) of the triangles, m

    @property
    def triangles(self) -> Nodes:
        """Number of triangles of each face, (f,)."""
        return np.bincount(self.face, minlength=len(self.corners))

    @property
    def most_triangles(self) -> int:
        """Largest number of triangles of a face."""
        return int(self.triangles.max())

    @property
    def extent(self) -> float:
        """Diagonal of the bounding box of the nodes, m."""
        return float(np.linalg.norm(np.ptp(self.x, axis=0)))

    @property
    def node_normals(self) -> Points:
        """Normalised sums (v, 3) of the normals of the faces at each node."""
        total, some = np.zeros_like(self.x), np.zeros_like(self.x)
        per_corner = np.repeat(self.normal[:, None], self.corners.shape[1], axis=1)
        some[self.corners] = per_corner
        np.add.at(total, self.corners, per_corner)
        return unit(total, some)

    @property
    def areas(self) -> Vector:
        """Nodal areas ∫N_j (v,), m²."""
        a, b = (self.vertices[:, k] - self.vertices[:, 0] for k in (1, 2))
        sixth = np.linalg.norm(np.cross(a, b), axis=1) / 6
        share = (sixth[:, None, None] * self.shape).sum(axis=1)  # (t, c)
        nodes = self.corners[self.face]
        total = np.bincount(nodes.ravel(), share.ravel(), minlength=len(self.x))
        return np.asarray(total, dtype=float)


def current_faces(x: Points, corners: Nodes, name: str) -> Faces:
    """Divide faces with corners (f, 3) or (f, 4), places in x (v, 3), into triangles.

    Raises
    ------
    InputError
        When a face has no area.

    """
    is_quad = corners[:, -1] != corners[:, -2] if corners.shape[1] == 4 else None
    at = x[corners]
    # twice the vector area, half the cross product of the diagonals; for a triangle
    # (a, b, c, c) these are two of its edges
    diagonals = at[:, 2] - at[:, 0], at[:, -1] - at[:, 1]
    area = np.cross(*diagonals)
    size = np.linalg.norm(area, axis=1)
    if not (size > 0).all():
        raise InputError(
            f"contact {name}: face {int(np.argmin(size > 0))} has no area; expected "
            "faces with three or four corners that are not on one line"
        )
    count = corners.shape[1]
    one = np.eye(count)
    if is_quad is None:
        is_quad = np.zeros(len(corners), dtype=bool)
    mean = np.full(count, 1 / count)
    fan = np.array([[one[k], one[(k + 1) % count], mean] for k in range(count)])
    number = np.where(is_quad, count, 1)
    face = np.repeat(np.arange(len(corners)), number)
    first = np.cumsum(number) - number
    place = np.arange(len(face)) - first[face]
    shape = np.where(is_quad[face][:, None, None], fan[place], one[None, :3])
    # of a triangle (a, b, c, c) the mean of three corners
    weight = np.where(is_quad[:, None], mean, np.append(np.full(3, 1 / 3), 0)[:count])
    centre = np.einsum("fc,fcx->fx", weight, at)
    radius = np.linalg.norm(at - centre[:, None], axis=2).max(axis=1)
    vertices = np.einsum("tvc,tcx->tvx", shape, at[face])
    return Faces(
        x, corners, centre, area / size[:, None], radius, face, shape, vertices
    )


def face_tangents(normal: Points) -> Points:
    """Return two orthonormal tangents (…, 2, 3) of unit normals (…, 3).

    The first is perpendicular to the axis that is nearest to perpendicular to n, so
    that neighbouring normals have neighbouring tangents on most of a side.
    """
    axis = np.eye(3)[np.abs(normal).argmin(axis=-1)]
    first = np.cross(axis, normal)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(normal, first)], axis=-2)
