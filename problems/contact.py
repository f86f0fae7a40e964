"""Node-to-segment non-penetration, linearised at a given displacement.

Each slave node is kept on the outer side of the master boundary. With its closest point
x_c = Σ N_a x_a on the master in the current configuration x = X + u^k and the master's
outward normal n there, the gap is g = (x_s − x_c)·n (positive: open), and to first
order in the total displacement u, with slave and parameters held,

    (x_s − x_c)·n ≥ 0    ⟺    B u ≤ c,    B = [−n at s, +N_a n at a],  c = g + B u^k

(the paper's B_M u ≤ c_M; its "Mortar" is this pointwise condition). Where the closest
point is a vertex of the master, n is the averaged normal of the segments that meet.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from harness import Vector
from problems.mesh import Nodes, as_vectors

ON_VERTEX = 1e-9  #: closest points nearer to a segment's end than this are the vertex


class ContactRows(NamedTuple):
    """The linear inequalities B u ≤ c on the total displacement u."""

    B: csr_array  #: (m_I, 2N) dimensionless
    c: Vector  #: (m_I,) m


class ClosestPoints(NamedTuple):
    """Closest points on a polyline."""

    segment: Nodes  #: (s,) segment that holds the closest point
    xi: Vector  #: (s,) its position there, 0 at the first node and 1 at the second
    normal: NDArray[np.float64]  #: (s, 2) outward unit normal of the master there


def node_to_segment(
    points: NDArray[np.float64], u: Vector, slave: Nodes, master: Nodes
) -> ContactRows:
    """Linearise the non-penetration of the slave nodes into the master boundary at u.

    Parameters
    ----------
    points : (N, 2) reference positions X
    u : (2N,) displacement u^k at which to linearise
    slave : (s,) nodes; each gets one row
    master : (v,) chain of nodes, its body on the left

    """
    x = points + as_vectors(u)
    at = closest_points(x[slave], x[master])
    N = np.stack([1 - at.xi, at.xi])
    ends = np.stack([master[at.segment], master[at.segment + 1]])
    foot = np.einsum("as,asx->sx", N, x[ends])
    gap = np.einsum("sx,sx->s", x[slave] - foot, at.normal)

    weight = np.concatenate([-np.ones((1, len(slave))), N])  # of s, 1, 2
    node = np.concatenate([slave[None], ends])
    values = weight[:, :, None] * at.normal
    columns = np.stack([2 * node, 2 * node + 1], axis=-1)
    rows = np.broadcast_to(np.arange(len(slave))[None, :, None], columns.shape)
    shape = (len(slave), points.size)
    B = csr_array(coo_array((values.ravel(), (rows.ravel(), columns.ravel())), shape))
    B.eliminate_zeros()
    return ContactRows(B, gap + B @ u)


def closest_points(
    x: NDArray[np.float64], polyline: NDArray[np.float64]
) -> ClosestPoints:
    """Find the closest points on a polyline (v, 2) and its outward normals there."""
    start, edge = polyline[:-1], np.diff(polyline, axis=0)
    length = np.linalg.norm(edge, axis=1)
    offset = x[:, None] - start  # (s, segments, 2)
    xi = np.clip(np.einsum("sex,ex->se", offset, edge) / length**2, 0, 1)
    distance = np.linalg.norm(offset - xi[..., None] * edge, axis=-1)
    segment = distance.argmin(axis=1)
    xi = xi[np.arange(len(x)), segment]

    normals = np.column_stack([edge[:, 1], -edge[:, 0]]) / length[:, None]
    padded = np.concatenate([normals[:1], normals, normals[-1:]])
    vertex = padded[:-1] + padded[1:]
    vertex /= np.linalg.norm(vertex, axis=1)[:, None]
    first, last = xi <= ON_VERTEX, xi >= 1 - ON_VERTEX
    normal = normals[segment]
    normal[first] = vertex[segment[first]]
    normal[last] = vertex[segment[last] + 1]
    return ClosestPoints(segment, np.where(first, 0, np.where(last, 1, xi)), normal)
