"""Node-to-segment non-penetration, linearised at a given displacement.

Each slave node must stay on the outer side of the master boundary. With its closest
point x_c = Σ N_a x_a on the master in the current configuration x = X + u^k and the
master's outward normal n there, the gap is g = (x_s − x_c)·n (positive: open). To first
order in the total displacement u, with N_a and n fixed at u^k,

    (x_s − x_c)·n ≥ 0    ⟺    B u ≤ c,    B = [−n at s, +N_a n at a],  c = g + B u^k

This is the paper's B_M u ≤ c_M (Section 2). The paper calls the method "Mortar", but
the condition is pointwise and fails the contact patch test; the method of
`problems.contact.mortar` passes this test. The normal n is that of the segment that
contains the closest point, or at a vertex the averaged normal of the two segments. If
the closest point is inside a segment, x_s − x_c ∥ n, and the forces Bᵀλ have no moment.

Friction acts along the tangent t = (−n_y, n_x), on the tangential motion

    T u,    T = [−t at s, +N_a t at a].

The friction forces are −Tᵀλ_t, by analogy with the contact forces −Bᵀλ.

For slave nodes beyond an end of the master, the closest point is the node at this end,
and n is the normal of the segment at this end.

A slave node can be assigned to a fixed segment. The node then stays on the outer side
of the whole line through this segment, irrespective of its closest point. Newton's
method requires this assignment at a re-entrant vertex of the master, where the force of
each segment pushes the node onto the other segment and the closest segment alternates
between iterations.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mortarbench.harness import Vector
from mortarbench.problems.contact.segment_search import nearest
from mortarbench.problems.contact.surface import (
    Points,
    Surface,
    current_positions,
    current_surface,
    tangents,
)
from mortarbench.problems.fem.elements import cross
from mortarbench.problems.fem.mesh import Nodes, dofs_of, nodal_lengths

#: closest points within this distance in ξ of an end of a segment are moved to this end
VERTEX_TOLERANCE = 1e-9


class ContactRows(NamedTuple):
    """Contact rows B u ≤ c for the total displacement u, and rows of the slip T u."""

    B: csr_array  #: (m_I, n) B_M of eq. (5), dimensionless
    c: Vector  #: (m_I,) c_M of eq. (5), m
    T: csr_array  #: (k, n) tangential rows, dim − 1 per contact row with friction
    row: Nodes  #: (k,) contact row of each tangential row
    #: (m_I,) ∫N_j over the slave side (for mortar contact, over its covered part, and
    #: with the weight |ν| in 2D), the length in m (2D) or the area in m² (3D) that is
    #: assigned to the row
    share: Vector
    #: (m_I,) index of the slave node of each row in `ContactPair.slave_nodes`
    place: Nodes


class ClosestPoints(NamedTuple):
    """Closest points of s positions on a chain of nodes."""

    #: (s,) position in the chain of the first node of the segment that contains the
    #: closest point
    segment: Nodes
    xi: Vector  #: (s,) coordinate on the segment, 0 at its first node, 1 at its second
    normal: Points  #: (s, 2) outward unit normal of the master at the closest point


def node_to_segment(
    points: Points,
    u: Vector,
    slave: Nodes,
    master: Nodes,
    *,
    tangential: bool = False,
    fixed_segments: Nodes | None = None,
) -> ContactRows:
    """Linearise the non-penetration condition of all slave nodes at u.

    The result has one contact row per slave node. B, c and T are defined in the module
    docstring.

    Parameters
    ----------
    points : (N, dim) reference positions X, m
    u : (n,) displacement u^k at which to linearise, m
    slave : (s,) chain of nodes with its body on the left
    master : (v,) chain of nodes with its body on the left
    tangential : add tangential rows for friction
    fixed_segments : (s,) fixed segment of each slave node, given by the position of its
        first node in the master chain; −1 selects the closest segment

    Raises
    ------
    InputError
        If a position is not finite or the master has no segment of positive length.

    """
    x = current_positions(points, u, slave, "slave")
    line = current_surface(points, u, master, "master")
    closest = _projections(x, line, fixed_segments)
    N = np.stack([1 - closest.xi, closest.xi], axis=1)
    ends = np.stack([closest.segment, closest.segment + 1], axis=1)
    foot = np.einsum("sa,sax->sx", N, line.x[ends])
    gap = np.einsum("sx,sx->s", x - foot, closest.normal)

    # (m, 3) stencil of each row: the slave node and both ends of the segment
    node = np.column_stack([slave, master[ends]])
    weight = np.column_stack([-np.ones(len(slave)), N])
    B = rows_along(node, weight, closest.normal, points.size)
    # friction rows have the weights of their contact row, along the tangents
    T, row = csr_array((0, points.size)), np.arange(0)
    if tangential:
        directions = tangents(closest.normal)
        row = np.repeat(np.arange(slave.size), directions.shape[1])
        along = directions.reshape(-1, points.shape[1])
        T = rows_along(node[row], weight[row], along, points.size)
    place = np.arange(slave.size)
    return ContactRows(B, gap + B @ u, T, row, nodal_lengths(x), place)


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
    points, u, slave, master, fixed_segments : see `node_to_segment`
    multipliers : (s,) λ, N/m

    Returns
    -------
    blocks (s, 6, 6), Pa, and their displacement components (s, 6), which are those of
    the slave node and of both ends of its segment

    """
    x = current_positions(points, u, slave, "slave")
    line = current_surface(points, u, master, "master")
    closest = _projections(x, line, fixed_segments)
    x_1, x_2 = line.x[closest.segment], line.x[closest.segment + 1]
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
    inside = (closest.xi > 0) & (closest.xi < 1)
    if fixed_segments is not None:
        inside |= fixed_segments >= 0
    blocks = -np.where(inside, multipliers, 0.0)[:, None, None] * gap_2
    nodes = np.column_stack(
        [slave, master[closest.segment], master[closest.segment + 1]]
    )
    return blocks, dofs_of(nodes, 2).reshape(-1, 6)


def closest_points(x: Points, line: Surface) -> ClosestPoints:
    """Return the closest points of x (s, 2) on a chain, with outward normals."""
    segment, xi = nearest(x, line)
    first, second = line.facets.T[:, segment]
    # snap to vertices, where the normal is averaged: rounding must not select a segment
    at_first, at_second = xi <= VERTEX_TOLERANCE, xi >= 1 - VERTEX_TOLERANCE
    xi = np.where(at_first, 0.0, np.where(at_second, 1.0, xi))
    normal = np.where(at_first[:, None], line.node_normal[first], line.normal[segment])
    normal = np.where(at_second[:, None], line.node_normal[second], normal)
    return ClosestPoints(first, xi, normal)


def _projections(
    x: Points, line: Surface, fixed_segments: Nodes | None
) -> ClosestPoints:
    """Return closest points of slave nodes x (s, 2) on the master.

    A node with a fixed segment is projected onto the line through this segment, where ξ
    may be outside [0, 1].
    """
    closest = closest_points(x, line)
    if fixed_segments is None or not (is_fixed := fixed_segments >= 0).any():
        return closest
    segment = np.where(is_fixed, fixed_segments, closest.segment)
    start = line.x[segment]
    edge = line.x[segment + 1] - start
    xi = np.einsum("sx,sx->s", x - start, edge) / np.einsum("sx,sx->s", edge, edge)
    length = np.linalg.norm(edge, axis=1)[:, None]
    across = -tangents(edge)[:, 0] / length
    return ClosestPoints(
        segment,
        np.where(is_fixed, xi, closest.xi),
        np.where(is_fixed[:, None], across, closest.normal),
    )


def rows_along(node: Nodes, weight: Vector, direction: Points, size: int) -> csr_array:
    """Assemble rows of weighted displacements along a direction, (m, size).

    Row r has the entries weight_ra · direction_r at the components of node_ra, for
    `node` and `weight` (m, k) and `direction` (m, dim). Zeros are not stored.
    """
    (m, k), dim = node.shape, direction.shape[1]
    if not m:
        return csr_array((0, size))
    values = weight[:, :, None] * direction[:, None, :]
    indptr = dim * k * np.arange(m + 1)
    B = csr_array((values.ravel(), dofs_of(node, dim), indptr), shape=(m, size))
    B.sum_duplicates()
    B.eliminate_zeros()
    return B
