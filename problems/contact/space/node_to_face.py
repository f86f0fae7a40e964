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

from functools import partial

import numpy as np

from mortarbench.harness import Vector
from mortarbench.problems.contact.rows import (
    ContactRows,
    Feet,
    SlaveNodes,
    nodal_rows,
)
from mortarbench.problems.contact.space.face_mortar import face_mortar
from mortarbench.problems.contact.space.triangles import (
    closest_points,
    projected_on_planes,
    triangulated,
)
from mortarbench.problems.contact.surface import Points, current_surface
from mortarbench.problems.fem.mesh import Nodes


def node_to_face(
    points: Points,
    u: Vector,
    slave: Nodes,
    master: Nodes,
    *,
    tangential: bool = False,
) -> ContactRows:
    """Linearise the non-penetration condition of all slave nodes at u.

    Parameters
    ----------
    points : (N, 3) reference positions X, m
    u : (3N,) displacement u^k at which to linearise, m
    slave, master : (f, 4), (g, 4) faces of both sides, boundaries of a `Mesh`
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
    at, N, normal = other.facets[closest.face], closest.N, closest.normal
    outside = np.flatnonzero(closest.beyond)
    if outside.size:  # opposite the extended plane of the nearest triangle
        t = closest.triangle[outside]
        weight = projected_on_planes(side.x[outside], faces.vertices[t])
        N[outside] = np.einsum("sv,svc->sc", weight, faces.shape[t])
        normal[outside] = faces.normals[t]
    foot = np.einsum("sa,sax->sx", N, other.x[at])
    radius = faces.radius[closest.face]
    return nodal_rows(
        u,
        SlaveNodes(own, side.x, side.areas),
        Feet(nodes[at], N, foot, normal, closest.beyond, radius),
        lambda: side,
        partial(
            face_mortar,
            points,
            u,
            slave,
            master,
            basis="standard",
            tangential=tangential,
        ),
        tangential=tangential,
    )
