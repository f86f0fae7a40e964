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
from mortarbench.problems.contact.mortar import mortar
from mortarbench.problems.contact.rows import (
    ContactRows,
    Feet,
    SlaveNodes,
    nodal_rows,
)
from mortarbench.problems.contact.segment_search import (
    ClosestPoints,
    along_lines,
    closest_points,
)
from mortarbench.problems.contact.surface import (
    Points,
    Surface,
    current_positions,
    current_surface,
    surface,
    tangents,
)
from mortarbench.problems.fem.elements import cross
from mortarbench.problems.fem.mesh import Nodes, dofs_of, nodal_lengths


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

    The result has one contact row per slave node, except for nodes beyond an end of the
    master. B, c and T are defined in the module docstring.

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
    radius = line.radius[closest.segment]
    return nodal_rows(
        u,
        SlaveNodes(slave, x, nodal_lengths(x)),
        Feet(master[ends], N, foot, closest.normal, closest.beyond, radius),
        lambda: surface(x, "slave"),
        partial(
            mortar, points, u, slave, master, basis="standard", tangential=tangential
        ),
        tangential=tangential,
    )


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


def _projections(
    x: Points, line: Surface, fixed_segments: Nodes | None
) -> ClosestPoints:
    """Return closest points of slave nodes x (s, 2) on the master, possibly extended.

    A node with a fixed segment, or beyond an end of the master, is projected onto the
    line through its segment, where ξ may be outside [0, 1].
    """
    closest = closest_points(x, line)
    segment, beyond = closest.segment, closest.beyond
    extended = beyond > 0
    if fixed_segments is not None:
        is_fixed = fixed_segments >= 0
        segment = np.where(is_fixed, fixed_segments, segment)
        beyond = np.where(is_fixed, 0.0, beyond)
        extended |= is_fixed
    if not extended.any():
        return closest
    xi, length = along_lines(x, line, segment)
    edge = line.x[segment + 1] - line.x[segment]
    across = -tangents(edge)[:, 0] / length[:, None]
    return ClosestPoints(
        segment,
        np.where(extended, xi, closest.xi),
        np.where(extended[:, None], across, closest.normal),
        beyond,
    )
