"""Node-to-segment non-penetration, linearised at a given displacement.

Each slave node is kept on the outer side of the master boundary. With its closest point
x_c = Σ N_a x_a on the master in the current configuration x = X + u^k and the master's
outward normal n there, the gap is g = (x_s − x_c)·n (positive: open), and to first
order in the total displacement u, with slave and parameters held,

    (x_s − x_c)·n ≥ 0    ⟺    B u ≤ c,    B = [−n at s, +N_a n at a],  c = g + B u^k

(the paper's B_M u ≤ c_M; its "Mortar" is this pointwise condition, which fails the
contact patch test; problems.contact.mortar passes it). The normal is that of the
segment that holds the closest point, and where that is a vertex the averaged normal of
the segments that meet. Where the closest point is inside a segment, x_s − x_c ∥ n, and
the forces Bᵀλ have no moment.

Friction acts along the tangent t = (−n_y, n_x), on the tangential motion

    T u,    T = [−t at s, +N_a t at a],

so that −Tᵀλ_t are the forces of friction where −Bᵀλ are those of the contact.

Beyond the end of the master its last node is the closest point, with the normal of the
last segment.

A slave node may be told to keep a segment: it is kept on the outer side of its whole
line, wherever the closest point is. At a vertex where the master bends inwards, a node
may find no rest otherwise: the force of either segment pushes it onto the other one.
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

#: closest points nearer to a segment's end than this are the vertex
VERTEX_TOLERANCE = 1e-9


class ContactRows(NamedTuple):
    """The linear inequalities B u ≤ c on the total displacement u, and its slip T u."""

    B: csr_array  #: (m_I, n) dimensionless
    c: Vector  #: (m_I,) m
    T: csr_array  #: (k, n) tangential rows, of d − 1 directions each; often none
    row: Nodes  #: (k,) the contact row that each of them belongs to
    share: Vector  #: (m_I,) of the slave side that a row stands for, ∫N_j, m
    place: Nodes  #: (m_I,) number of its node in the slave chain


class ClosestPoints(NamedTuple):
    """Closest points on a chain of nodes."""

    segment: Nodes  #: (s,) the closest point lies between this node and the next
    xi: Vector  #: (s,) its place there, 0 at the first node and 1 at the second
    normal: Points  #: (s, 2) outward unit normal of the master there


def node_to_segment(
    points: Points,
    u: Vector,
    slave: Nodes,
    master: Nodes,
    *,
    tangential: bool = False,
    fixed_segments: Nodes | None = None,
) -> ContactRows:
    """Linearise the non-penetration of the slave nodes into the master boundary at u.

    Every slave node has a row.

    Parameters
    ----------
    points : (N, dim) reference positions X, m
    u : (n,) displacement u^k at which to linearise, m
    slave : (s,) chain of nodes, its body on the left
    master : (v,) chain of nodes, its body on the left
    tangential : whether friction needs tangential rows
    fixed_segments : (s,) first node, in the master chain, of the segment that a slave
        node keeps; −1 where it is the closest one

    Raises
    ------
    InputError
        When a position is not finite or a chain needed has no segment.

    """
    x = current_positions(points, u, slave, "slave")
    line = current_surface(points, u, master, "master")
    at = _opposite(x, line, fixed_segments)
    N = np.stack([1 - at.xi, at.xi], axis=1)
    ends = np.stack([at.segment, at.segment + 1], axis=1)
    foot = np.einsum("sa,sax->sx", N, line.x[ends])
    gap = np.einsum("sx,sx->s", x - foot, at.normal)

    node = np.column_stack([slave, master[ends]])  # s, 1, 2
    weight = np.column_stack([-np.ones(len(slave)), N])
    B = rows_along(node, weight, at.normal, points.size)
    T, row = csr_array((0, points.size)), np.arange(0)
    if tangential:
        directions = tangents(at.normal)
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
    """Differentiate the forces Bᵀλ of the slave nodes, λ held: −λ g''(u), per node.

    With the edge e = x_2 − x_1 of the segment and d = x_s − x_1 the gap is the area
    a = d_x e_y − d_y e_x over the length L = |e|, and

        g'' = a''/L − (a' L'ᵀ + L' a'ᵀ)/L² − a L''/L² + 2a L' L'ᵀ/L³.

    Where the closest point is a vertex of the master, whose averaged normal has no
    derivative of its own here, it is taken to be zero.

    Parameters
    ----------
    points, u, slave, master, fixed_segments : as of `node_to_segment`
    multipliers : (s,) λ, N/m

    Returns
    -------
    blocks (s, 6, 6), Pa, and the displacement components (s, 6) that they are of: those
    of the slave node and of both ends of its segment

    """
    x = current_positions(points, u, slave, "slave")
    line = current_surface(points, u, master, "master")
    at = _opposite(x, line, fixed_segments)
    x_1, x_2 = line.x[at.segment], line.x[at.segment + 1]
    d, e = x - x_1, x_2 - x_1
    L = np.linalg.norm(e, axis=1)
    t, area = e / L[:, None], cross(d, e)
    one, turn = np.eye(2), np.array([[0.0, 1.0], [-1.0, 0.0]])  # a = dᵀ turn e
    in_d, in_e = np.hstack([one, -one, 0 * one]), np.hstack([0 * one, -one, one])
    area_1 = (e @ turn.T) @ in_d + (d @ turn) @ in_e  # (s, 6)
    area_2 = in_d.T @ turn @ in_e
    length_1 = t @ in_e
    across = (one - t[:, :, None] * t[:, None, :]) / L[:, None, None]
    length_2 = in_e.T @ across @ in_e

    def outer(a: Points, b: Points) -> NDArray[np.float64]:
        return a[:, :, None] * b[:, None, :]

    mixed, (L, area) = outer(area_1, length_1), (v[:, None, None] for v in (L, area))
    gap_2 = (area_2 + area_2.T) / L - (mixed + mixed.transpose(0, 2, 1)) / L**2
    gap_2 += area * (2 * outer(length_1, length_1) / L**3 - length_2 / L**2)
    inside = (at.xi > 0) & (at.xi < 1)
    if fixed_segments is not None:
        inside |= fixed_segments >= 0
    blocks = -np.where(inside, multipliers, 0.0)[:, None, None] * gap_2
    nodes = np.column_stack([slave, master[at.segment], master[at.segment + 1]])
    return blocks, dofs_of(nodes, 2).reshape(-1, 6)


def closest_points(x: Points, line: Surface) -> ClosestPoints:
    """Find the closest points of x (s, 2) on a chain and its outward normals there."""
    segment, xi = nearest(x, line)
    first, second = line.facets.T[:, segment]
    at_first, at_second = xi <= VERTEX_TOLERANCE, xi >= 1 - VERTEX_TOLERANCE
    xi = np.where(at_first, 0.0, np.where(at_second, 1.0, xi))
    normal = np.where(at_first[:, None], line.node_normal[first], line.normal[segment])
    normal = np.where(at_second[:, None], line.node_normal[second], normal)
    return ClosestPoints(first, xi, normal)


def _opposite(x: Points, line: Surface, fixed_segments: Nodes | None) -> ClosestPoints:
    """Find what the slave nodes x (s, 2) stand against: the closest, or what is kept.

    On the line of a segment that is kept, ξ may be outside of [0, 1].
    """
    at = closest_points(x, line)
    if fixed_segments is None or not (own := fixed_segments >= 0).any():
        return at
    segment = np.where(own, fixed_segments, at.segment)
    start = line.x[segment]
    edge = line.x[segment + 1] - start
    xi = np.einsum("sx,sx->s", x - start, edge) / np.einsum("sx,sx->s", edge, edge)
    length = np.linalg.norm(edge, axis=1)[:, None]
    across = -tangents(edge)[:, 0] / length
    return ClosestPoints(
        segment, np.where(own, xi, at.xi), np.where(own[:, None], across, at.normal)
    )


def rows_along(node: Nodes, weight: Vector, direction: Points, size: int) -> csr_array:
    """Build rows that weight the displacements of equally many nodes along a direction.

    Row r is Σ_a weight_ra · direction_r at the components of node_ra: node and weight
    are (m, k), direction is (m, dim), the result (m, size) without stored zeros.
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
