"""Node-to-face non-penetration in 3D, linearised at a given displacement.

Each slave node stays on the outer side of the master, as in 2D
(`problems.contact.node_to_segment`). With the closest point x_c = Σ N_a x_a on the
master faces and the outward normal n at x_c, the condition is B u ≤ c with
B = [−n at s, +N_a n at a] and c = g + B u^k.

The closest point is determined on the triangles of the faces
(`problems.contact.space.triangles`). The normal n is that of the face; at an edge or a
corner where several faces meet, their normals are averaged. For
slave nodes beyond the border of the master, see `problems.contact.rows`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mortarbench.harness import Vector
from mortarbench.problems.contact.rows import ContactRows, Feet, nodal_rows
from mortarbench.problems.contact.segment_search import Reach
from mortarbench.problems.contact.space.face_mortar import face_mortar
from mortarbench.problems.contact.space.triangles import FaceTriangles, triangulated
from mortarbench.problems.contact.surface import Points, current_surface
from mortarbench.problems.fem.mesh import Nodes

#: the closest points on two faces are the same point of a common edge if their
#: distance, relative to the radius of a face, is below this value
SAME_POINT = 1e-9


class ClosestPoints(NamedTuple):
    """Closest points of s positions on faces."""

    face: Nodes  #: (s,) face that contains the closest point
    #: (s, 4) shape functions of the face at the closest point; beyond the border, at
    #: the foot on the plane of the nearest triangle
    N: NDArray[np.float64]
    normal: Points  #: (s, 3) outward unit normal of the master at the closest point
    #: (s,) distance along the master by which a point is beyond its border, m; else 0
    beyond: Vector


def node_to_face(
    points: Points,
    u: Vector,
    slave: Nodes,
    master: Nodes,
    *,
    reach: Reach = Reach(),  # noqa: B008 - frozen
    tangential: bool = False,
) -> ContactRows:
    """Linearise the non-penetration condition of all slave nodes at u.

    Parameters
    ----------
    points : (N, 3) reference positions X, m
    u : (3N,) displacement u^k at which to linearise, m
    slave, master : (f, 4), (g, 4) faces of both sides, boundaries of a `Mesh`
    reach : limits on the distance of a node and, for the side as a whole, on the angle
    tangential : add two tangential rows per contact row

    Returns
    -------
    one contact row per slave node, in ascending order of their numbers, except for
    nodes beyond the border of the master

    Raises
    ------
    InputError
        If a position is not finite or a face has no area.

    """
    own, nodes = np.unique(slave), np.unique(master)
    side, other = (
        current_surface(points, u, faces, name)
        for faces, name in ((slave, "slave"), (master, "master"))
    )
    faces = triangulated(other)
    closest = closest_points(side.x, faces)
    at = other.facets[closest.face]
    return nodal_rows(
        u,
        own,
        side,
        Feet(
            nodes[at],
            closest.N,
            np.einsum("sa,sax->sx", closest.N, other.x[at]),
            closest.normal,
            closest.beyond,
            faces.radius[closest.face],
        ),
        (reach.max_distance(side, other), reach.cosine),
        lambda part: face_mortar(
            points,
            u,
            slave,
            master,
            basis="standard",
            part=part,
            reach=reach,
            tangential=tangential,
        ),
        tangential=tangential,
    )


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
    across = np.cross(edges[:, 0], edges[:, 1])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    outwards = np.cross(edges, across[:, None])
    outwards /= np.linalg.norm(outwards, axis=2, keepdims=True)
    on_border = border & (np.roll(barycentric, -2, axis=1) <= 0) & meets[:, None]
    excess = np.einsum("pkx,px->pk", outwards, x[node] - at)
    excess[~on_border | (excess <= SAME_POINT * faces.radius[faces.face[t], None])] = 0
    beyond = np.zeros(len(x))
    np.maximum.at(beyond, node, excess.max(axis=1))
    # beyond the border, the face is extended
    outside, weight = (beyond > 0)[:, None], barycentric[best]
    weight = np.where(outside, feet_in_planes(x, faces.vertices[t[best]]), weight)
    normal = np.where(outside, across[best], normal)
    N = np.einsum("sv,svc->sc", weight, faces.shape[t[best]])
    return ClosestPoints(face, N, normal, beyond)


def feet_in_planes(x: Points, triangle: Points) -> NDArray[np.float64]:
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
    foot = feet_in_planes(x, triangle)
    length = np.einsum("pkx,pkx->pk", edges, edges)
    along = np.clip(np.einsum("pkx,pkx->pk", offset, edges) / length, 0.0, 1.0)
    away = offset - along[..., None] * edges
    k = np.einsum("pkx,pkx->pk", away, away).argmin(axis=1)
    p = np.arange(len(x))
    on_edge = np.zeros((len(x), 3))
    on_edge[p, k], on_edge[p, (k + 1) % 3] = 1 - along[p, k], along[p, k]
    inside = np.asarray((foot >= 0).all(axis=1))
    return np.where(inside[:, None], foot, on_edge)
