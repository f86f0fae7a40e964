"""Segment-to-segment mortar contact in two dimensions, linearised at a displacement.

Source: Popp, Gee and Wall, "A finite deformation mortar contact formulation using a
primal-dual active set strategy", Int. J. Numer. Meth. Engng 79 (2009) 1354-1391; for
partly covered slave elements: Popp, Seitz, Gee and Wall, Comput. Methods Appl. Mech.
Engrg. 264 (2013) 67-80. The terms "normal field" and "ray" are not from these papers.

On the slave segment between the nodes 1 and 2 let ξ ∈ [−1, 1], N_1 = (1 − ξ)/2,
N_2 = (1 + ξ)/2, and let ν(ξ) = N_1 n_1 + N_2 n_2 interpolate the averaged normals of
the nodes. The ray from x(ξ) along n = ν/|ν| meets the master at x(ξ) + g n, which
defines the gap g(ξ) (positive: open) and the master's shape functions N^m_l(ξ) there.
The contact traction is Σ λ_j Φ_j ν, and the weak non-penetration condition is
∫ Φ_j |ν| g ≥ 0. Linearised at u^k with fixed rays and normals, it reads for every slave
node j

    Σ_k D_jkᵀ u_k − Σ_l M_jlᵀ u_l ≤ g̃_j + (the left-hand side at u^k),
    D_jk = ∫ Φ_j N_k ν,   M_jl = ∫ Φ_j N^m_l ν,   g̃_j = ∫ Φ_j |ν| g.

*Balance.* At every Gauss point a row exerts the force Φ_j ν on the slave at x(ξ) and
−Φ_j ν on the master at x(ξ) + g n, along the same line. Up to rounding, the forces of a
row are therefore in equilibrium and have no moment, even on curved sides. (With n_j
outside the integrals, the moments would be O(h²). A body supported by contact alone
would then rotate until a row far from the contact, at the end of an arc, balances the
moments of the active rows.) Because ν is not normalised, the gap has the weight |ν| = 1
− O(h²). In return, the integrands of D are polynomials, which the Gauss rule integrates
exactly: on fully covered segments, D is independent of the position of the master's
nodes, and the resultant force of a row of the dual basis on the slave acts along n_j.

The integrals run over the part of the slave that the master covers. They are sums over
*integration segments*, the overlaps of one slave with one master segment, where the
integrand is smooth, with three Gauss points each.

*Overlap.* A point p lies on the ray of ξ if f(ξ) = (x(ξ) − p) × (N_1 n_1 + N_2 n_2)
vanishes; f is quadratic in ξ. The rays of the two nodes enclose the points with
f(−1) ≥ 0 ≥ f(1) (on the near side of their intersection). The master segment is clipped
by these two lines, and its remaining ends are projected by the unique root of f in
[−1, 1].

*Basis.* "standard" is Φ_j = N_j. "dual" is biorthogonal on the covered part of each
segment, ∫ Φ_j N_k = δ_jk ∫ N_k. D is then diagonal on straight sides, and diagonal
up to O(h) on curved ones. With the mean ξ̄ and the variance v of ξ over the covered
part, and N̄_j = N_j(ξ̄), the only linear solution is

    Φ_1 = N̄_1 − κ (ξ − ξ̄),   Φ_2 = N̄_2 + κ (ξ − ξ̄),   κ = 2 N̄_1 N̄_2 / v

For a fully covered segment, Φ_1 = 2N_1 − N_2 and Φ_2 = 2N_2 − N_1.

Friction rows have (−ν_y, ν_x) in place of ν; across an open gap, their forces have a
moment. For both bases, the friction bound of a row under Tresca's law is the bound on
the traction times ∫ N_j |ν|.

Each row is divided by ∫ N_j |ν| over the covered part. Thus B is dimensionless, g̃ a
length, and λ a nodal force per thickness as in node-to-segment contact, up to O(h²) on
curved sides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mortarbench.harness import Vector
from mortarbench.problems.contact.rows import (
    ContactRows,
    gathered,
    mortar_rows,
    side_matrix,
)
from mortarbench.problems.contact.surface import (
    Points,
    Reach,
    Surface,
    current_surface,
    tangents,
    unit,
)
from mortarbench.problems.fem.elements import cross
from mortarbench.problems.fem.mesh import Nodes

#: integration segments whose length in ξ is at most this value count as rounding errors
#: of the projection and are dropped
MIN_SEGMENT = 1e-8
#: averaged normals of a straight side differ by at most this value. Smaller components
#: of ν − n_j count as zero, so that B is as sparse on straight sides as with a single
#: normal
NORMAL_ROUNDING = 4 * np.finfo(float).eps
PAIRS = 2**20  #: largest number of pairs of nodes that are evaluated at a time
ABSCISSAE, WEIGHTS = np.polynomial.legendre.leggauss(3)

Basis = Literal["dual", "standard"]


@dataclass(frozen=True, eq=False)
class Mortar:
    """Mortar integrals of a pair of sides, with nodes numbered along their chains.

    The columns of D and M are displacement components in the order of `dofs_of`.
    """

    D: csr_array  #: (s, 2s) ∫ Φ_j N_k ν, m
    M: csr_array  #: (s, 2v) ∫ Φ_j N^m_l ν, m
    gap: Vector  #: (s,) g̃_j = ∫ Φ_j |ν| g, m²
    cover: Vector  #: (s,) ∫ N_j |ν|, m; 0 for nodes that the master does not cover
    covered: Vector  #: (s,) ∫ N_j over the covered part, m


class Overlaps(NamedTuple):
    """Integration segments: overlaps of slave segments with master segments."""

    slave: Nodes  #: (p,) slave segment of each integration segment, ascending
    master: Nodes  #: (p,) master segment of each integration segment
    xi: NDArray[np.float64]  #: (p, 2) coordinates ξ of both ends, ascending


class GaussPoints(NamedTuple):
    """Gauss points of the integration segments."""

    slave: Nodes  #: (p,) slave segment of each integration segment, ascending
    master: Nodes  #: (p,) master segment of each integration segment
    xi: NDArray[np.float64]  #: (p, 3) coordinate on the slave segment, in [−1, 1]
    beta: NDArray[np.float64]  #: (p, 3) coordinate on the master segment, in [0, 1]
    field: NDArray[np.float64]  #: (p, 3, 2) ν(ξ), |ν| ≤ 1
    gap: NDArray[np.float64]  #: (p, 3) gap g(ξ), m
    weight: NDArray[np.float64]  #: (p, 3) quadrature weights, m


def mortar(
    points: Points,
    u: Vector,
    slave: Nodes,
    master: Nodes,
    *,
    basis: Basis = "dual",
    reach: Reach = Reach(),  # noqa: B008 - frozen
    tangential: bool = False,
    part: NDArray[np.bool_] | None = None,
) -> ContactRows:
    """Linearise the weak non-penetration condition at u, with a row per covered node.

    Parameters
    ----------
    points : (N, 2) reference positions X, m
    u : (2N,) displacement u^k at which to linearise, m
    slave, master : (s,), (v,) chains of nodes with their body on the left
    basis : multiplier basis, "dual" or "standard"
    reach : limits on the angle and distance of integration segments. Without a limit on
        the angle, rays can graze a distant master side. Weighted gaps between separate
        bodies could then be negative, because dual basis functions take negative values
    tangential : add tangential rows for friction
    part : mask (f,) of the slave facets over which to integrate; None selects all

    Raises
    ------
    InputError
        If a position is not finite or a side has no segment.

    """
    s = current_surface(points, u, slave, "slave")
    m = current_surface(points, u, master, "master")
    integrals = integrate(s if part is None else s.part(part), m, basis, reach)
    j = np.flatnonzero(integrals.cover)
    B = mortar_rows(
        integrals.D, integrals.M, integrals.cover, (slave, master), points.size
    )
    T = _rotated(B if tangential else B[:0])
    return ContactRows(
        B,
        integrals.gap[j] / integrals.cover[j] + B @ u,
        T,
        np.arange(T.shape[0]),
        integrals.cover[j],
        j,
        integrals.covered[j] / s.areas[j],
        np.arange(j.size),
    )


def integrate(slave: Surface, master: Surface, basis: Basis, reach: Reach) -> Mortar:
    """Compute D, M, weighted gaps and covered lengths by Gauss quadrature."""
    gauss = cast_rays(slave, master, overlaps(slave, master), reach)
    N = _shape(gauss.xi)
    phi = _dual(gauss) if basis == "dual" else N
    s, v = len(slave.x), len(master.x)
    j, k = slave.facets[gauss.slave], master.facets[gauss.master]  # (p, 2) nodes
    weighted = phi * gauss.weight[..., None]  # (p, 3, 2)
    overlap = np.einsum("pgj,pgk->pjk", weighted, N)
    if basis == "dual":  # summed over a slave segment, ∫Φ_jN_k = δ_jk ∫Φ_j exactly
        overlap = np.eye(2) * weighted.sum(axis=1)[:, None]
    # ∫Φ_j N_k ν = n_j ∫Φ_j N_k + ∫Φ_j N_k (ν − n_j)
    n_j = slave.node_normal[j]  # (p, 2, 2)
    deviation = gauss.field[:, :, None] - n_j[:, None]
    deviation[np.abs(deviation) <= NORMAL_ROUNDING] = 0
    D = overlap[..., None] * n_j[:, :, None]
    D += np.einsum("pgjx,pgk->pjkx", weighted[..., None] * deviation, N)
    # M has the same ν and weights as D, so that the forces of a row balance
    pull = weighted[..., None] * gauss.field[:, :, None]  # (p, 3, 2, 2)
    M = np.einsum("pgjx,pgl->pjlx", pull, _shape(2 * gauss.beta - 1))
    measure = gauss.weight * np.linalg.norm(gauss.field, axis=-1)
    gap = np.einsum("pgj,pg->pj", phi, measure * gauss.gap)
    cover = np.einsum("pgj,pg->pj", N, measure)
    return Mortar(
        side_matrix(D, j, j, (s, s)),
        side_matrix(M, j, k, (s, v)),
        gathered(gap, j, s),
        gathered(cover, j, s),
        gathered(np.einsum("pgj,pg->pj", N, gauss.weight), j, s),
    )


def facing_segments(slave: Surface, master: Surface) -> tuple[Nodes, Nodes]:
    """Return the pairs of slave and master segments that may overlap along normals.

    Let f_j(p) = (x_j − p) × n_j for the slave node j at x_j with the averaged normal
    n_j. A point p lies between the lines along the normals of nodes j and j + 1 if
    f_j(p) ≥ 0 ≥ f_{j+1}(p). The master segment of each returned pair has a point with
    f_j ≥ 0 and a point with f_{j+1} ≤ 0.

    Returns
    -------
    slave segments, master segments : (p,) each, sorted by slave segment

    """
    x, n = slave.x, slave.node_normal
    offset, across = cross(x, n)[:, None], tangents(n)[:, 0]
    (j, k), (a, b) = slave.facets.T, master.facets.T
    pairs, step = [], max(PAIRS // len(master.x), 1)
    for first in range(0, len(j), step):
        part = slice(first, first + step)
        # signs of f at the nodes of the master
        at_j = across[j[part]] @ master.x.T >= -offset[j[part]]
        at_k = across[k[part]] @ master.x.T <= -offset[k[part]]
        above, below = at_j[:, a] | at_j[:, b], at_k[:, a] | at_k[:, b]
        e, m = np.nonzero(above & below)
        pairs.append((first + e, m))
    e, m = map(np.concatenate, zip(*pairs, strict=True))
    return e, m


def overlaps(slave: Surface, master: Surface) -> Overlaps:
    """Return all integration segments, without limits on angle or distance."""
    e, m = facing_segments(slave, master)
    nodes = slave.facets.T[:, e]
    x, n = slave.x[nodes], slave.node_normal[nodes]  # (2, p, 2)
    A, B = master.start[m], master.end[m]
    # [low, high] is the part of the master segment AB between the lines of the normals
    low, high = np.zeros(len(e)), np.ones(len(e))
    for side, (x_j, n_j) in zip((1.0, -1.0), zip(x, n, strict=True), strict=True):
        f_A, f_B = side * cross(x_j - A, n_j), side * cross(x_j - B, n_j)  # ≥ 0 inside
        splits = (f_A < 0) != (f_B < 0)  # the line crosses AB, at `place`
        place = f_A / np.where(splits, f_A - f_B, 1.0)
        # a segment that is outside as a whole becomes empty: low = 1, high = 0
        low = np.where(f_A < 0, np.where(splits, np.maximum(low, place), 1.0), low)
        high = np.where(f_B < 0, np.where(splits, np.minimum(high, place), 0.0), high)
    ends = np.stack(
        [project(x, n, A + t[:, None] * (B - A)) for t in (low, high)], axis=1
    )
    # both sides run anticlockwise around their bodies, so that ξ decreases along AB
    ends = np.sort(np.clip(ends, -1.0, 1.0), axis=1)
    valid = (low < high) & (ends[:, 1] - ends[:, 0] > MIN_SEGMENT)
    return Overlaps(e[valid], m[valid], ends[valid])


def project(x: Points, n: Points, p: Points) -> Vector:
    """Project points p (k, 2) along normal fields onto slave segments; return ξ (k,).

    x and n (2, k, 2) are the ends of the segments and the normals at these ends. With
    x(ξ) = a_0 + p + ξ a_1 and n(ξ) = b_0 + ξ b_1,

        f(ξ) = (x(ξ) − p) × n(ξ) = q_2 ξ² + q_1 ξ + q_0.

    The function returns the root with f′ ≤ 0. If p lies between the lines along the end
    normals, this is the only root in [−1, 1]. If no ray meets p, the value is finite
    but meaningless.
    """
    a_0, a_1 = (x[0] + x[1]) / 2 - p, (x[1] - x[0]) / 2
    b_0, b_1 = (n[0] + n[1]) / 2, (n[1] - n[0]) / 2
    q_2, q_1, q_0 = cross(a_1, b_1), cross(a_0, b_1) + cross(a_1, b_0), cross(a_0, b_0)
    # (−q_1 − √…)/(2 q_2), rewritten to avoid cancellation for q_2 → 0
    root = np.sqrt(np.maximum(q_1**2 - 4 * q_2 * q_0, 0.0)) - q_1
    return 2 * q_0 / np.where(root > 0, root, np.inf)


def cast_rays(
    slave: Surface, master: Surface, parts: Overlaps, reach: Reach
) -> GaussPoints:
    """Cast rays from the Gauss points; drop segments beyond the reach."""
    e, m, ends = parts
    half = (ends[:, 1] - ends[:, 0]) / 2
    xi = ends.mean(axis=1)[:, None] + half[:, None] * ABSCISSAE
    N, (j, k) = _shape(xi), slave.facets.T[:, e]
    edge = slave.end[e] - slave.start[e]
    x = slave.start[e][:, None] + N[..., 1:] * edge[:, None]
    field = N[..., :1] * slave.node_normal[j][:, None]
    field += N[..., 1:] * slave.node_normal[k][:, None]
    n = unit(field, slave.normal[e][:, None])  # ν may vanish between opposite normals

    A, B = master.start[m][:, None], master.end[m][:, None]
    f_A, f_B = cross(x - A, n), cross(x - B, n)  # opposite signs: the ray hits AB
    beta = np.clip(f_A / (f_A - f_B), 0.0, 1.0)
    gap = np.einsum("pgx,pgx->pg", A + beta[..., None] * (B - A) - x, n)

    # cosine of the angle at the middle Gauss point
    cosine = np.einsum("px,px->p", n[:, 1], master.normal[m])
    near = (cosine <= reach.cosine) & (
        np.abs(gap).max(axis=1) <= reach.max_distance(slave, master)
    )
    # dx = half·|edge|/2 dt on t ∈ [−1, 1]
    weight = WEIGHTS * (half * np.linalg.norm(edge, axis=1) / 2)[:, None]
    return GaussPoints(*(a[near] for a in (e, m, xi, beta, field, gap, weight)))


def _dual(gauss: GaussPoints) -> NDArray[np.float64]:
    """Evaluate the dual basis Φ_1, Φ_2 on each slave segment, (p, 3, 2)."""
    w = gauss.weight
    total = np.bincount(gauss.slave, w.sum(axis=1))

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        sums = np.bincount(gauss.slave, (w * values).sum(axis=1))
        return (sums[gauss.slave] / total[gauss.slave])[:, None]

    centre = mean(gauss.xi)
    offset = gauss.xi - centre
    offset = offset - mean(offset)  # correct rounding of ξ̄, because v may be tiny
    N = _shape(centre)
    slope = 2 * N[..., 0] * N[..., 1] / mean(offset**2) * offset
    return N + np.stack([-slope, slope], axis=-1)


def _shape(xi: NDArray[np.float64]) -> NDArray[np.float64]:
    """Evaluate N_1, N_2 at ξ, (…, 2)."""
    return np.stack([(1 - xi) / 2, (1 + xi) / 2], axis=-1)


def _rotated(B: csr_array) -> csr_array:
    """Rotate the entries (x, y) of each row (m, 2N) at each node to (−y, x)."""
    y = B.indices % 2
    T = csr_array(
        (np.where(y, -B.data, B.data), B.indices + 1 - 2 * y, B.indptr), B.shape
    )
    T.sort_indices()
    return T
