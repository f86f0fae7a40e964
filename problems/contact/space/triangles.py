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
from scipy.spatial import KDTree

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


#: the closest points on two faces are the same point of a common edge if their
#: distance, relative to the radius of a face, is below this value
SAME_POINT = 1e-9


class ClosestPoints(NamedTuple):
    """Closest points of s positions on faces."""

    face: Nodes  #: (s,) face that contains the closest point
    triangle: Nodes  #: (s,) triangle of this face
    N: NDArray[np.float64]  #: (s, 4) shape functions of the face at the closest point
    normal: Points  #: (s, 3) outward unit normal of the master at the closest point
    #: (s,) distance along the master by which a point is beyond its border, m; else 0
    beyond: Vector


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
    def normals(self) -> Points:
        """Unit normals of the triangles, (t, 3)."""
        a, b = (self.vertices[:, k] - self.vertices[:, 0] for k in (1, 2))
        across = np.cross(a, b)
        return np.asarray(across / np.linalg.norm(across, axis=1, keepdims=True))

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


def closest_points(x: Points, faces: FaceTriangles) -> ClosestPoints:
    """Return the closest points of x (s, 3) on faces, with outward normals."""
    tree = KDTree(faces.centre)
    # `nearest` is the distance to the closest centre of a face. Faces contain their
    # centres, so the distance to the closest point is at most `nearest`. The distance
    # to the centre of the face that contains this point is larger by at most the radius
    # of the face
    nearest, _ = tree.query(x)
    found = tree.query_ball_point(x, nearest * (1 + SAME_POINT) + faces.radius.max())
    candidate = np.concatenate([np.asarray(k, dtype=np.int64) for k in found])
    t, pair = faces.of_faces(candidate)
    node = np.repeat(np.arange(len(x)), [len(k) for k in found])[pair]
    border = faces.border[t]
    barycentric = closest_in_triangles(x[node], faces.vertices[t])
    at = np.einsum("pv,pvx->px", barycentric, faces.vertices[t])
    distance = np.linalg.norm(at - x[node], axis=1)
    order = np.lexsort([distance, node])
    best = order[np.unique(node[order], return_index=True)[1]]
    # average the normals of all faces that meet at the closest point
    same = np.linalg.norm(at - at[best][node], axis=1)
    meets = same <= SAME_POINT * faces.radius[faces.face[t]]
    touching = np.unique(np.stack([node, faces.face[t]])[:, meets], axis=1)
    total = np.zeros_like(x)
    np.add.at(total, touching[0], faces.surface.normal[touching[1]])
    size = np.linalg.norm(total, axis=1, keepdims=True)
    face = faces.face[t[best]]
    normal = np.where(
        size > 0, total / np.where(size > 0, size, 1), faces.surface.normal[face]
    )
    # components of x − x_c outwards, along the faces whose border contains x_c
    edges = np.roll(faces.vertices[t], -1, axis=1) - faces.vertices[t]
    outwards = np.cross(edges, faces.normals[t, None])
    outwards /= np.linalg.norm(outwards, axis=2, keepdims=True)
    on_border = border & (np.roll(barycentric, -2, axis=1) <= 0) & meets[:, None]
    excess = np.einsum("pkx,px->pk", outwards, x[node] - at)
    excess[~on_border | (excess <= SAME_POINT * faces.radius[faces.face[t], None])] = 0
    beyond = np.zeros(len(x))
    np.maximum.at(beyond, node, excess.max(axis=1))
    N = np.einsum("sv,svc->sc", barycentric[best], faces.shape[t[best]])
    return ClosestPoints(face, t[best], N, normal, beyond)


def projected_on_planes(x: Points, triangle: Points) -> NDArray[np.float64]:
    """Return barycentric coordinates (p, 3) of the projections of x (p, 3).

    triangle : (p, 3, 3) vertices
    """
    edges = np.roll(triangle, -1, axis=1) - triangle  # edge k from vertex k to k + 1
    offset = x[:, None] - triangle
    normal = np.cross(edges[:, 0], edges[:, 1])
    square = np.einsum("px,px->p", normal, normal)[:, None]
    # the barycentric coordinate of vertex k + 2 is the area over edge k
    parts = np.einsum("pkx,px->pk", np.cross(edges, offset), normal) / square
    return np.roll(parts, 2, axis=1)


def closest_in_triangles(x: Points, triangle: Points) -> NDArray[np.float64]:
    """Return barycentric coordinates (p, 3) of the closest points of x (p, 3).

    The closest point is the foot of the perpendicular if the foot is inside the
    triangle, and otherwise the closest point of the nearest edge.

    triangle : (p, 3, 3) vertices
    """
    edges = np.roll(triangle, -1, axis=1) - triangle  # edge k from vertex k to k + 1
    offset = x[:, None] - triangle
    foot = projected_on_planes(x, triangle)
    length = np.einsum("pkx,pkx->pk", edges, edges)
    along = np.clip(np.einsum("pkx,pkx->pk", offset, edges) / length, 0.0, 1.0)
    away = offset - along[..., None] * edges
    k = np.einsum("pkx,pkx->pk", away, away).argmin(axis=1)
    p = np.arange(len(x))
    on_edge = np.zeros((len(x), 3))
    on_edge[p, k], on_edge[p, (k + 1) % 3] = 1 - along[p, k], along[p, k]
    inside = np.asarray((foot >= 0).all(axis=1))
    return np.where(inside[:, None], foot, on_edge)
