"""Segment-to-segment mortar contact in two dimensions, linearised at a displacement.

Source: Popp, Gee and Wall, "A finite deformation mortar contact formulation using a
primal-dual active set strategy", Int. J. Numer. Meth. Engng 79 (2009) 1354-1391; for
slave elements covered in part: Popp, Seitz, Gee and Wall, Comput. Methods Appl. Mech.
Engrg. 264 (2013) 67-80; "normal field" and "ray" are our words.

On the slave segment between the nodes 1 and 2 let ξ ∈ [−1, 1], N_1 = (1 − ξ)/2,
N_2 = (1 + ξ)/2, and let ν(ξ) = N_1 n_1 + N_2 n_2 interpolate the averaged normals of
the nodes. The ray from x(ξ) along n = ν/|ν| meets the master at x(ξ) + g n, which
defines the gap g(ξ) (positive: open) and the master's shape functions N^m_l(ξ) there.
The contact traction is Σ λ_j Φ_j ν, the impenetrability holds in the weak sense
∫ Φ_j |ν| g ≥ 0, and linearised with rays and normals held it is, for every slave node
j,

    Σ_k D_jkᵀ u_k − Σ_l M_jlᵀ u_l ≤ g̃_j + the same of u^k,
    D_jk = ∫ Φ_j N_k ν,   M_jl = ∫ Φ_j N^m_l ν,   g̃_j = ∫ Φ_j |ν| g.

*Balance.* At every Gauss point a row pulls the slave by Φ_j ν at x(ξ) and the master by
−Φ_j ν at x(ξ) + g n, on the same line. So the forces of a row balance and have no
moment, to rounding, on curved sides as well. (With n_j outside of the integrals the
moments are O(h²). A body that contact alone holds then turns until a row far from the
contact, at the end of an arc, balances those of the rows that press.) That ν is not
normalised is a weight of 1 − O(h²). The integrals for D are of polynomials with it,
which the Gauss points integrate exactly: no division of the slave by the master's nodes
changes D, and a row of the dual basis pulls the slave along n_j.

The integrals run over the part of the slave that the master covers. They are sums over
*integration segments*, the overlap of one slave with one master segment, where the
integrand is smooth: three Gauss points each.

*Overlap.* A point p lies on the ray of ξ if f(ξ) = (x(ξ) − p) × (N_1 n_1 + N_2 n_2)
vanishes, a quadratic of ξ. The rays of the two nodes enclose the points with
f(−1) ≥ 0 ≥ f(1) (on the near side of the point where they meet); the master segment is
clipped by these two lines, and the ends of what is left are projected by the one root
that then lies in [−1, 1].

*Basis.* "standard" is Φ_j = N_j. "dual" is biorthogonal on the covered part of each
segment, ∫ Φ_j N_k = δ_jk ∫ N_k, so that D is diagonal on straight sides, and on curved
ones but for O(h). With the mean ξ̄ and the variance v of ξ over the covered part, and
N̄_j = N_j(ξ̄), the one linear solution is

    Φ_1 = N̄_1 − κ (ξ − ξ̄),   Φ_2 = N̄_2 + κ (ξ − ξ̄),   κ = 2 N̄_1 N̄_2 / v

(for a fully covered segment 2N_1 − N_2 and 2N_2 − N_1).

The tangential rows of friction are the same with (−ν_y, ν_x) for ν; across a gap their
forces have a moment. A constant bound of the traction is multiplied by ∫ N_j |ν| for
each row, with either basis.

Each row is divided by ∫ N_j |ν| over the covered part: so B is dimensionless, g̃ a
length, and λ a nodal force per thickness as with node-to-segment, up to O(h²) on curved
sides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from mortarbench.harness import Vector
from mortarbench.problems.contact.node_to_segment import ContactRows
from mortarbench.problems.contact.segment_search import Reach, facing_segments
from mortarbench.problems.contact.surface import (
    Points,
    Surface,
    current_surface,
    unit,
)
from mortarbench.problems.fem.elements import cross
from mortarbench.problems.fem.mesh import Nodes, dofs_of

#: shorter integration segments, in ξ, are noise of the projection and are left out
MIN_SEGMENT = 1e-8
#: normals of a straight side differ by as much
NORMAL_ROUNDING = 4 * np.finfo(float).eps
ABSCISSAE, WEIGHTS = np.polynomial.legendre.leggauss(3)

Basis = Literal["dual", "standard"]


@dataclass(frozen=True, eq=False)
class Mortar:
    """Mortar integrals of a pair of sides, numbered along their chains.

    The columns of D and M are components of displacement, see `dofs_of`.
    """

    D: csr_array  #: (s, 2s) ∫ Φ_j N_k ν, m
    M: csr_array  #: (s, 2v) ∫ Φ_j N^m_l ν, m
    gap: Vector  #: (s,) g̃_j = ∫ Φ_j |ν| g, m²
    cover: Vector  #: (s,) ∫ N_j |ν|, m; 0 where no master is in reach


class Overlaps(NamedTuple):
    """Integration segments: where a master segment covers a slave segment."""

    slave: Nodes  #: (p,) slave segment, ascending
    master: Nodes  #: (p,) master segment
    xi: NDArray[np.float64]  #: (p, 2) ends on the slave segment, ascending


class GaussPoints(NamedTuple):
    """Quadrature on the integration segments."""

    slave: Nodes  #: (p,) slave segment, ascending
    master: Nodes  #: (p,) master segment
    xi: NDArray[np.float64]  #: (p, 3) on the slave segment, in [−1, 1]
    beta: NDArray[np.float64]  #: (p, 3) on the master segment, in [0, 1]
    field: NDArray[np.float64]  #: (p, 3, 2) ν(ξ), |ν| ≤ 1
    gap: NDArray[np.float64]  #: (p, 3) m
    weight: NDArray[np.float64]  #: (p, 3) m


def mortar(
    points: Points,
    u: Vector,
    slave: Nodes,
    master: Nodes,
    *,
    basis: Basis = "dual",
    reach: Reach = Reach(),  # noqa: B008 - frozen
    tangential: bool = False,
) -> ContactRows:
    """Linearise the weak non-penetration of two sides at u; one row per covered node.

    Parameters
    ----------
    points : (N, 2) reference positions X, m
    u : (2N,) displacement u^k at which to linearise, m
    slave, master : (s,), (v,) chains of nodes, their bodies on the left
    basis : of the multiplier, "dual" or "standard"
    reach : which integration segments count. Without the limit on the angle, rays that
        graze a far master give the dual basis, which is negative in places, negative
        weighted gaps between bodies that are apart
    tangential : whether friction needs tangential rows

    Raises
    ------
    InputError
        When a position is not finite or a side has no segment.

    """
    s = current_surface(points, u, slave, "slave")
    m = current_surface(points, u, master, "master")
    integrals = integrate(s, m, basis, reach)
    j = np.flatnonzero(integrals.cover)
    B = _rows(integrals, j, (slave, master), points.shape)
    T = _turned(B if tangential else B[:0])
    return ContactRows(
        B, integrals.gap[j] / integrals.cover[j] + B @ u,
        T, np.arange(T.shape[0]), integrals.cover[j], j,
    )  # fmt: skip


def integrate(slave: Surface, master: Surface, basis: Basis, reach: Reach) -> Mortar:
    """Compute D, M and the weighted gaps."""
    at = cast_rays(slave, master, overlaps(slave, master), reach)
    N = _shape(at.xi)
    phi = _dual(at) if basis == "dual" else N
    s, v = len(slave.x), len(master.x)
    j, k = slave.facets[at.slave], master.facets[at.master]  # (p, 2) nodes
    weighted = phi * at.weight[..., None]  # (p, 3, 2)
    overlap = np.einsum("pgj,pgk->pjk", weighted, N)
    if basis == "dual":  # what cancels in sums over the segments, left out
        overlap = np.eye(2) * weighted.sum(axis=1)[:, None]
    own = slave.node_normal[j]  # (p, 2, 2)
    bent = at.field[:, :, None] - own[:, None]  # ν − n_j
    bent[np.abs(bent) <= NORMAL_ROUNDING] = 0
    D = overlap[..., None] * own[:, :, None]
    D += np.einsum("pgjx,pgk->pjkx", weighted[..., None] * bent, N)
    pull = weighted[..., None] * at.field[:, :, None]  # (p, 3, 2, 2)
    M = np.einsum("pgjx,pgl->pjlx", pull, _shape(2 * at.beta - 1))
    measure = at.weight * np.linalg.norm(at.field, axis=-1)
    gap = np.einsum("pgj,pg->pj", phi, measure * at.gap)
    cover = np.einsum("pgj,pg->pj", N, measure)
    return Mortar(
        _sum(D, j, j, (s, s)), _sum(M, j, k, (s, v)),
        _gather(gap, j, s), _gather(cover, j, s),
    )  # fmt: skip


def overlaps(slave: Surface, master: Surface) -> Overlaps:
    """Find the integration segments, before any filter."""
    e, m = facing_segments(slave, master)
    nodes = slave.facets.T[:, e]
    x, n = slave.x[nodes], slave.node_normal[nodes]  # (2, p, 2)
    A, B = master.start[m], master.end[m]
    low, high = np.zeros(len(e)), np.ones(len(e))
    for side, (x_j, n_j) in zip((1.0, -1.0), zip(x, n, strict=True), strict=True):
        f_A, f_B = side * cross(x_j - A, n_j), side * cross(x_j - B, n_j)  # ≥ 0 inside
        splits = (f_A < 0) != (f_B < 0)
        place = f_A / np.where(splits, f_A - f_B, 1.0)
        low = np.where(f_A < 0, np.where(splits, np.maximum(low, place), 1.0), low)
        high = np.where(f_B < 0, np.where(splits, np.minimum(high, place), 0.0), high)
    ends = np.stack(
        [project(x, n, A + t[:, None] * (B - A)) for t in (low, high)], axis=1
    )
    ends = np.sort(np.clip(ends, -1.0, 1.0), axis=1)
    kept = (low < high) & (ends[:, 1] - ends[:, 0] > MIN_SEGMENT)
    return Overlaps(e[kept], m[kept], ends[kept])


def project(x: Points, n: Points, p: Points) -> Vector:
    """Project points p (k, 2) along the normal fields of segments onto these.

    x and n are (2, k, 2), the ends and their normals. With x(ξ) = x_0 + ξ x_1 and
    n(ξ) = n_0 + ξ n_1, (x(ξ) − p) × n(ξ) = q_2 ξ² + q_1 ξ + q_0. Returned is the root
    at which it falls, the only one in [−1, 1] where p lies between the end normals;
    where no ray meets p it is finite but means nothing.
    """
    a_0, a_1 = (x[0] + x[1]) / 2 - p, (x[1] - x[0]) / 2
    b_0, b_1 = (n[0] + n[1]) / 2, (n[1] - n[0]) / 2
    q_2, q_1, q_0 = cross(a_1, b_1), cross(a_0, b_1) + cross(a_1, b_0), cross(a_0, b_0)
    # (−q_1 − √…)/(2 q_2) without its cancellation
    root = np.sqrt(np.maximum(q_1**2 - 4 * q_2 * q_0, 0.0)) - q_1
    return 2 * q_0 / np.where(root > 0, root, np.inf)


def cast_rays(
    slave: Surface, master: Surface, parts: Overlaps, reach: Reach
) -> GaussPoints:
    """Place Gauss points, cast their rays, and leave out the segments out of reach."""
    e, m, ends = parts
    half = (ends[:, 1] - ends[:, 0]) / 2
    xi = ends.mean(axis=1)[:, None] + half[:, None] * ABSCISSAE
    N, (j, k) = _shape(xi), slave.facets.T[:, e]
    edge = slave.end[e] - slave.start[e]
    x = slave.start[e][:, None] + N[..., 1:] * edge[:, None]
    field = N[..., :1] * slave.node_normal[j][:, None]
    field += N[..., 1:] * slave.node_normal[k][:, None]
    n = unit(field, slave.normal[e][:, None])

    A, B = master.start[m][:, None], master.end[m][:, None]
    f_A, f_B = cross(x - A, n), cross(x - B, n)  # of opposite signs: the ray hits AB
    beta = np.clip(f_A / (f_A - f_B), 0.0, 1.0)
    gap = np.einsum("pgx,pgx->pg", A + beta[..., None] * (B - A) - x, n)

    cosine = np.einsum("px,px->p", n[:, 1], master.normal[m])  # at the middle
    kept = (cosine <= reach.cosine) & (
        np.abs(gap).max(axis=1) <= reach.max_distance(slave, master)
    )
    weight = WEIGHTS * (half * np.linalg.norm(edge, axis=1) / 2)[:, None]
    return GaussPoints(*(a[kept] for a in (e, m, xi, beta, field, gap, weight)))


def _dual(at: GaussPoints) -> NDArray[np.float64]:
    """Evaluate the dual basis of the covered part of each slave segment, (p, 3, 2)."""
    w = at.weight
    total = np.bincount(at.slave, w.sum(axis=1))

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        sums = np.bincount(at.slave, (w * values).sum(axis=1))
        return (sums[at.slave] / total[at.slave])[:, None]

    centre = mean(at.xi)
    offset = at.xi - centre
    offset = offset - mean(offset)  # the first mean is rounded, v may be small
    N = _shape(centre)
    slope = 2 * N[..., 0] * N[..., 1] / mean(offset**2) * offset
    return N + np.stack([-slope, slope], axis=-1)


def _shape(xi: NDArray[np.float64]) -> NDArray[np.float64]:
    """Evaluate N_1, N_2 at ξ, (…, 2)."""
    return np.stack([(1 - xi) / 2, (1 + xi) / 2], axis=-1)


def _gather(values: NDArray[np.float64], nodes: Nodes, count: int) -> Vector:
    """Add values (p, 2) at nodes (p, 2) into a vector (count,)."""
    total = np.bincount(nodes.ravel(), values.ravel(), minlength=count)
    return total.astype(np.float64)  # of no values NumPy makes integers


def _sum(
    vectors: NDArray[np.float64], rows: Nodes, nodes: Nodes, shape: tuple[int, int]
) -> csr_array:
    """Add vectors (p, 2, 2, dim) into a matrix at rows (p, 2) × nodes (p, 2).

    shape : counts of rows and nodes; a node has a column for each component
    """
    dim = vectors.shape[-1]
    i = np.repeat(rows, 2 * dim, axis=1)
    j = np.tile(dofs_of(nodes, dim).reshape(-1, 2 * dim), (1, 2))
    at = (i.ravel(), j.ravel())
    return csr_array(coo_array((vectors.ravel(), at), (shape[0], dim * shape[1])))


def _rows(
    integrals: Mortar, j: Nodes, sides: tuple[Nodes, Nodes], shape: tuple[int, int]
) -> csr_array:
    """Build (D u_s − M u_m)_j / cover_j for the slave nodes j as a matrix on u.

    shape : of all nodes (N, dim)
    """
    N, dim = shape
    D, M = integrals.D[j].tocoo(), integrals.M[j].tocoo()
    row = np.concatenate([D.row, M.row])
    slave, master = (dofs_of(side, dim) for side in sides)
    at = (row, np.concatenate([slave[D.col], master[M.col]]))
    values = np.concatenate([D.data, -M.data]) / integrals.cover[j][row]
    B = csr_array(coo_array((values, at), (len(j), N * dim)))
    B.eliminate_zeros()
    return B


def _turned(B: csr_array) -> csr_array:
    """Turn the vector (x, y) that a row (m, 2N) has at a node to (−y, x)."""
    y = B.indices % 2
    T = csr_array(
        (np.where(y, -B.data, B.data), B.indices + 1 - 2 * y, B.indptr), B.shape
    )
    T.sort_indices()
    return T
