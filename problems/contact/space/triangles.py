"""Faces of contact sides in 3D, divided into triangles.

A quadrilateral face is divided into four triangles about the mean of its corners. Its
shape functions are linear on each triangle and ¼ at the centre. Thus the surface is
continuous, and integrals over overlaps of two sides are exact. On plane faces, the
integrals ∫N_j equal those of the bilinear shape functions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector
from mortarbench.problems.contact.surface import Points, Surface
from mortarbench.problems.fem.mesh import Nodes

_CORNERS = np.eye(4)
#: (4, 3, 4) shape functions at the vertices of the triangles of a quadrilateral
_QUAD = np.array(
    [[_CORNERS[k], _CORNERS[(k + 1) % 4], np.full(4, 0.25)] for k in range(4)]
)
#: (3, 4) shape functions at the vertices of a triangular face, which is stored with its
#: last corner repeated
_TRIANGLE = _CORNERS[:3]


class FaceTriangles(NamedTuple):
    """Triangles of the faces of a contact side in 3D."""

    surface: Surface
    centre: Points  #: (f, 3) means of the corners of each face, m
    radius: Vector  #: (f,) largest distance of a corner from the centre, m
    number: Nodes  #: (f,) number of triangles of each face, 1 or 4
    face: Nodes  #: (t,) face of each triangle, ascending
    #: (t, 3, 4) shape functions of the face at the vertices of the triangle
    shape: NDArray[np.float64]
    vertices: Points  #: (t, 3, 3) positions of the vertices, m

    @property
    def border(self) -> NDArray[np.bool_]:
        """Mask (t, 3) of the edges from vertex k to k + 1 that bound a single face."""
        facets = self.surface.facets
        node = np.take_along_axis(facets[self.face], self.shape.argmax(axis=2), axis=1)
        node[self.shape.max(axis=2) < 1] = -1  # the centre of a quadrilateral
        low, high = np.sort(np.stack([node, np.roll(node, -1, axis=1)]), axis=0)
        edge = low * len(self.surface.x) + high
        _, place, count = np.unique(edge, return_inverse=True, return_counts=True)
        once = (count == 1)[place].reshape(edge.shape)
        return np.asarray(once & (low >= 0))

    def of_faces(self, faces: Nodes) -> tuple[Nodes, Nodes]:
        """Return the triangles (k,) of the given faces (p,).

        The second result (k,) is the index in `faces` of the face of each triangle.
        """
        count = self.number[faces]
        place = np.repeat(np.arange(len(faces)), count)
        offset = np.arange(len(place)) - np.repeat(np.cumsum(count) - count, count)
        return np.searchsorted(self.face, faces)[place] + offset, place


def triangulated(surface: Surface) -> FaceTriangles:
    """Divide the faces of a surface into triangles."""
    is_quad = surface.facets[:, 3] != surface.facets[:, 2]
    at = surface.x[surface.facets]
    number = np.where(is_quad, 4, 1)
    face = np.repeat(np.arange(len(number)), number)
    edge = np.arange(len(face)) - np.repeat(np.cumsum(number) - number, number)
    shape = np.where(is_quad[face, None, None], _QUAD[edge], _TRIANGLE)
    centre = np.where(is_quad[:, None], at.mean(axis=1), at[:, :3].mean(axis=1))
    radius = np.linalg.norm(at - centre[:, None], axis=2).max(axis=1)
    vertices = np.einsum("tvc,tcx->tvx", shape, at[face])
    return FaceTriangles(surface, centre, radius, number, face, shape, vertices)
