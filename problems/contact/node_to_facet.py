"""Node-to-segment (3D: node-to-face) non-penetration, linearised at a displacement.

Each slave node must stay on the outer side of the master boundary. With its closest
point x_c = Σ N_a x_a on the master in the current configuration x = X + u^k and the
master's outward normal n there, the gap is g = (x_s − x_c)·n (positive: open). To first
order in the total displacement u, with N_a and n fixed at u^k,

    (x_s − x_c)·n ≥ 0    ⟺    B u ≤ c,    B = [−n at s, +N_a n at a],  c = g + B u^k

This is the paper's B_M u ≤ c_M (Section 2). The paper calls the method "Mortar", but
the condition is pointwise and fails the contact patch test; the method of
`problems.contact.mortar` passes this test. The normal n is that of the facet that
contains the closest point or, where several facets meet there, their averaged normal.
If the closest point is inside a facet, x_s − x_c ∥ n, and the forces Bᵀλ have no
moment.

Friction acts along the tangent t = (−n_y, n_x), or in 3D along two tangents, on the
tangential motion

    T u,    T = [−t at s, +N_a t at a].

The friction forces are −Tᵀλ_t, by analogy with the contact forces −Bᵀλ.

For slave nodes beyond an end of the master, see `problems.contact.rows`.

A slave node can be assigned to a fixed segment. The node then stays on the outer side
of the whole line through this segment, irrespective of its closest point. Newton's
method requires this assignment at a re-entrant vertex of the master, where the force of
each segment pushes the node onto the other segment and the closest segment alternates
between iterations.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector
from mortarbench.problems.contact.face_mortar import face_mortar
from mortarbench.problems.contact.mortar import mortar
from mortarbench.problems.contact.rows import (
    EXTENSION,
    ContactRows,
    rows_along,
    with_integrals,
)
from mortarbench.problems.contact.surface import (
    SAME_POINT,
    ClosestPoints,
    Points,
    Simplices,
    closest_points,
    current_positions,
    current_surface,
    divided,
    projected,
    tangents,
)
from mortarbench.problems.fem.elements import cross
from mortarbench.problems.fem.mesh import Nodes, dofs_of, nodal_lengths, nodes_of_side


def node_to_facet(
    points: Points,
    u: Vector,
    slave: Nodes,
    master: Nodes,
    *,
    tangential: bool = False,
    fixed_segments: Nodes | None = None,
) -> ContactRows:
    """Linearise the non-penetration condition of all slave nodes at u.

    The result has one contact row per slave node, except for nodes beyond the border of
    the master. B, c and T are defined in the module docstring.

    Parameters
    ----------
    points : (N, dim) reference positions X, m
    u : (n,) displacement u^k at which to linearise, m
    slave, master : sides, which are boundaries of a `Mesh`
    tangential : add dim − 1 tangential rows per contact row for friction
    fixed_segments : (s,) fixed segment of each slave node (2D), numbered as in
        `Surface.facets`; −1 selects the closest segment

    Raises
    ------
    InputError
        If a position is not finite, the master has no segment of positive length, or a
        face has no area.

    """
    dim, own = points.shape[1], nodes_of_side(slave)
    x = current_positions(points, u, own, "slave")
    side = divided(current_surface(points, u, master, "master"))
    closest = _projections(x, side, fixed_segments)
    corners = side.surface.facets[closest.facet]
    foot = np.einsum("sa,sax->sx", closest.N, side.surface.x[corners])
    gap = np.einsum("sx,sx->s", x - foot, closest.normal)
    # stencil of each row: the slave node and the nodes of the master facet
    node = np.column_stack([own, nodes_of_side(master)[corners]])
    weight = np.column_stack([-np.ones(own.size), closest.N])
    B = rows_along(node, weight, closest.normal, u.size)
    # friction rows have the weights of their contact row, along the tangents
    along = tangents(closest.normal)[: own.size if tangential else 0]
    row, every = np.repeat(np.arange(len(along)), dim - 1), np.arange(own.size)
    T = rows_along(node[row], weight[row], along.reshape(-1, dim), u.size)
    areas = (
        nodal_lengths(x)
        if dim == 2
        else current_surface(points, u, slave, "slave").areas
    )
    one = np.ones(own.size)
    rows = ContactRows(B, gap + B @ u, T, row, areas, every, one, every)
    if closest.beyond.any():
        faces = current_surface(points, u, slave, "slave")
        radius = np.minimum(faces.radius, side.radius[closest.facet])
        # the tolerance is for rounding of distances
        outside = closest.beyond > EXTENSION * radius * (1 + SAME_POINT)
        if outside.any():
            sides = partial(mortar if dim == 2 else face_mortar, points, u, slave)
            integral = partial(sides, master, basis="standard", tangential=tangential)
            return with_integrals(rows, faces, outside, integral)
    return rows


def geometric_stiffness(
    points: Points,
    u: Vector,
    slave: Nodes,
    master: Nodes,
    multipliers: Vector,
    fixed_segments: Nodes | None = None,
) -> tuple[NDArray[np.float64], Nodes]:
    """Differentiate Bᵀλ at fixed λ: return the block −λ g''(u) of each slave node.

    With the edge e = x_2 − x_1 of the segment and d = x_s − x_1, the gap is g = a/L
    with the area a = d_x e_y − d_y e_x and the length L = |e|, and

        g'' = a''/L − (a' L'ᵀ + L' a'ᵀ)/L² − a L''/L² + 2a L' L'ᵀ/L³.

    If the closest point is a vertex of the master and the segment is not fixed, the
    block is set to zero, because the derivative of the averaged normal is not
    implemented.

    Parameters
    ----------
    points, u, slave, master, fixed_segments : see `node_to_facet`
    multipliers : (s,) λ, N/m

    Returns
    -------
    blocks (s, 6, 6), Pa, and their displacement components (s, 6), which are those of
    the slave node and of both ends of its segment

    """
    x = current_positions(points, u, slave, "slave")
    line = current_surface(points, u, master, "master")
    closest = _projections(x, divided(line), fixed_segments)
    ends = line.facets[closest.facet]
    x_1, x_2 = line.x[ends[:, 0]], line.x[ends[:, 1]]
    d, e = x - x_1, x_2 - x_1
    L = np.linalg.norm(e, axis=1)
    t, area = e / L[:, None], cross(d, e)
    one, J = np.eye(2), np.array([[0.0, 1.0], [-1.0, 0.0]])  # a = dᵀJe
    in_d, in_e = np.hstack([one, -one, 0 * one]), np.hstack([0 * one, -one, one])
    # suffixes _1, _2: first and second derivatives by the six components
    area_1 = (e @ J.T) @ in_d + (d @ J) @ in_e  # (s, 6)
    area_2 = in_d.T @ J @ in_e  # a'' = area_2 + area_2ᵀ
    length_1 = t @ in_e
    across = (one - t[:, :, None] * t[:, None, :]) / L[:, None, None]
    length_2 = in_e.T @ across @ in_e

    def outer(a: Points, b: Points) -> NDArray[np.float64]:
        return a[:, :, None] * b[:, None, :]

    mixed, (L, area) = outer(area_1, length_1), (v[:, None, None] for v in (L, area))
    gap_2 = (area_2 + area_2.T) / L - (mixed + mixed.transpose(0, 2, 1)) / L**2
    gap_2 += area * (2 * outer(length_1, length_1) / L**3 - length_2 / L**2)
    inside = ((closest.N > 0) & (closest.N < 1)).all(axis=1)
    if fixed_segments is not None:
        inside |= fixed_segments >= 0
    blocks = -np.where(inside, multipliers, 0.0)[:, None, None] * gap_2
    nodes = np.column_stack([slave, master[ends]])
    return blocks, dofs_of(nodes, 2).reshape(-1, 6)


def _projections(
    x: Points, side: Simplices, fixed_segments: Nodes | None
) -> ClosestPoints:
    """Return closest points of slave nodes x (s, dim) on the master, possibly extended.

    A node with a fixed segment, or beyond the border of the master, is projected onto
    the line through its segment (the plane through its triangle), where shape functions
    may be negative.
    """
    closest = closest_points(x, side)
    facet, simplex, N, normal, beyond = closest
    extended = beyond > 0
    if fixed_segments is not None:
        is_fixed = fixed_segments >= 0
        facet = np.where(is_fixed, fixed_segments, facet)
        simplex = np.where(is_fixed, fixed_segments, simplex)
        beyond = np.where(is_fixed, 0.0, beyond)
        extended |= is_fixed
    outside = np.flatnonzero(extended)
    t = simplex[outside]
    coordinates = projected(x[outside], side.vertices[t])
    N[outside] = np.einsum("sv,svc->sc", coordinates, side.shape[t])
    normal[outside] = side.normals[t]
    return ClosestPoints(facet, simplex, N, normal, beyond)
