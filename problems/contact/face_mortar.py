"""Three-dimensional face-to-face mortar contact, linearised at a displacement.

Sources: Puso and Laursen, "A mortar segment-to-segment contact method for large
deformation solid mechanics", Comput. Methods Appl. Mech. Engrg. 193 (2004) 601-629, for
the auxiliary plane; Popp, Gitterle, Gee and Wall, Int. J. Numer. Meth. Engng 83 (2010)
1428-1465, for the dual basis. The two-dimensional method is in
`problems.contact.mortar`.

*Triangles.* A quadrilateral face is divided into four triangles about the mean of its
corners. Its shape functions N_k are linear on each triangle and ¼ at the centre. (With
two triangles, or with the bilinear functions, whose inverse map is not polynomial, a
distorted face fails the patch test.)

*Auxiliary plane.* On the slave face e with centre x_e and unit normal n_e, points of
both sides are projected along n_e onto the plane through x_e. On this plane each slave
triangle is clipped by each master triangle (Sutherland and Hodgman 1974). On the
overlap, a convex polygon with at most six corners, all integrands are polynomials of
degree 2. Their integrals follow from the moments of the polygon, without quadrature.

*Rows.* With the gap g along n_e (positive: open) and the basis Φ_j of the multipliers,
the weak condition ∫ Φ_j g ≥ 0 reads for every slave node j, linearised at u^k with
fixed planes and overlaps,

    Σ_k D_jkᵀ u_k − Σ_l M_jlᵀ u_l ≤ g̃_j + (the left-hand side at u^k),
    D_jk = Σ_e n_e ∫_e Φ_j N_k,   M_jl = Σ_e n_e ∫_e Φ_j N^m_l,   g̃_j = Σ_e ∫_e Φ_j g.

*Balance.* At each point of an overlap, a row exerts the force Φ_j n_e on the slave and
−Φ_j n_e on the master, on the same line along n_e. The forces of a row are therefore in
equilibrium and have no moment.

*Basis.* "standard" is Φ_j = N_j. "dual" is Φ = A N on each face with A = D_e M_e⁺,
where M_e = ∫ N Nᵀ and D_e = diag ∫ N over the covered part of the face. Then ∫ Φ_j N_k
is diagonal if M_e is nonsingular, and Σ Φ_j = 1 in all cases, since D_e 1 = M_e 1. M_e
is singular if only one triangle of a quadrilateral is covered.

Each row is divided by ∫ N_j over the covered part, so that B is dimensionless, g̃ a
length, and λ a nodal force.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack

from mortarbench.harness import Vector
from mortarbench.problems.contact.mortar import Basis
from mortarbench.problems.contact.rows import (
    ContactRows,
    gathered,
    mortar_rows,
    side_matrix,
)
from mortarbench.problems.contact.surface import (
    Points,
    Reach,
    Simplices,
    current_surface,
    divided,
    tangents,
)
from mortarbench.problems.fem.mesh import Nodes

#: overlaps whose area is at most this factor times the squared radius of the slave face
#: count as rounding errors of the projection and are dropped
MIN_OVERLAP = 1e-12
#: eigenvalues of M_e below this fraction of the largest count as zero
SINGULAR = 1e-10
#: distances from a line below this fraction of the size of a triangle count as zero
ON_LINE = 1e-14
#: largest number of pairs of triangles clipped at a time; limits the memory to about
#: 100 MB
CHUNK = 2**16
#: distance from the nearest centre of a master face at which the search along a ray
#: ends, in units of the radius of the slave face plus the largest radius of a master
#: face. Smaller values require more steps, larger values yield more candidate faces
CLOSE = 1.5
#: largest number of steps of the search along a ray. Each step covers at least half of
#: the remaining distance, up to the radii of the faces, to a side that is inclined by
#: at most 60° (`Reach.cosine`)
MAX_STEPS = 64
#: radius, in the units of CLOSE, of a ball about the end of the search that contains
#: all faces met by rays from a slave face: CLOSE / cos 60° along the ray, tan 60°
#: across it
MAX_SPREAD = 5.0
#: largest number of corners of a triangle clipped by a triangle
MAX_CORNERS = 6


class Overlaps(NamedTuple):
    """Integrals over the overlaps of pairs of faces, on the auxiliary planes.

    N_j are the shape functions of the slave face, N^m_l those of the master face.
    """

    slave: Nodes  #: (p,) slave face of each pair
    master: Nodes  #: (p,) master face of each pair
    area: NDArray[np.float64]  #: (p, 4) ∫N_j, m²
    own: NDArray[np.float64]  #: (p, 4, 4) ∫N_j N_k, m²
    other: NDArray[np.float64]  #: (p, 4, 4) ∫N_j N^m_l, m²
    gap: NDArray[np.float64]  #: (p, 4) ∫N_j g, m³


def face_mortar(
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
    points : (N, 3) reference positions X, m
    u : (3N,) displacement u^k at which to linearise, m
    slave, master : (f, 4), (g, 4) faces of both sides, boundaries of a `Mesh`
    basis, reach, tangential, part : see `problems.contact.mortar.mortar`

    Returns
    -------
    rows of the covered slave nodes, in ascending order of their numbers

    Raises
    ------
    InputError
        If a position is not finite or a face has no area.

    """
    s, m = (
        current_surface(points, u, side, name)
        for side, name in ((slave, "slave"), (master, "master"))
    )
    nodes = np.unique(slave), np.unique(master)
    own, other = divided(s), divided(m)
    at = overlaps(own if part is None else divided(s.part(part)), other, reach)
    A = _dual(at) if basis == "dual" else np.eye(4)  # Φ = A N
    at = at if part is None else at._replace(slave=np.flatnonzero(part)[at.slave])
    j, k = s.facets[at.slave], m.facets[at.master]
    cover = gathered(at.area, j, len(s.x))
    gap = gathered((A @ at.gap[..., None])[..., 0], j, len(s.x))
    active = np.flatnonzero(cover)
    D, M = A @ at.own, A @ at.other
    normal = np.broadcast_to(s.normal[at.slave][:, None], (*j.shape, 3))

    def rows(direction: Points) -> csr_array:
        """Return rows along directions (p, 4, 3) of the slave nodes of each overlap."""
        blocks = (values[..., None] * direction[:, :, None] for values in (D, M))
        left, right = (
            side_matrix(block, j, at, (len(s.x), side.size))
            for block, at, side in zip(blocks, (j, k), nodes, strict=True)
        )
        return mortar_rows(left, right, cover, nodes, points.size)

    B = rows(normal)
    T, row = csr_array((0, points.size)), np.arange(0)
    if tangential:
        axes = s.tangents  # (v, 2, 3)
        stacked = [rows(axes[j, axis]) for axis in range(2)]
        row = np.repeat(np.arange(active.size), 2)
        # both tangents of a row in succession
        order = np.arange(2 * active.size).reshape(2, -1).T.ravel()
        T = csr_array(vstack(stacked).tocsr()[order])
    return ContactRows(
        B,
        gap[active] / cover[active] + B @ u,
        T,
        row,
        cover[active],
        active,
        (cover / _integrals_of(own))[active],
        np.arange(active.size),
    )


def _integrals_of(side: Simplices) -> Vector:
    """Return ∫N_j (v,) over the faces, projected onto their auxiliary planes."""
    a, b = (side.vertices[:, k] - side.vertices[:, 0] for k in (1, 2))
    area = np.einsum("tx,tx->t", np.cross(a, b), side.surface.normal[side.facet]) / 2
    integrals = area[:, None] * side.shape.mean(axis=1)
    nodes = side.surface.facets[side.facet]
    return gathered(integrals, nodes, len(side.surface.x))


def overlaps(slave: Simplices, master: Simplices, reach: Reach) -> Overlaps:
    """Clip the triangles of both sides on the auxiliary planes of the slave faces."""
    e, m = _facing(slave, master, reach)
    step = CHUNK // (slave.number.max() * master.number.max())
    parts = [
        _integrals(slave, master, e[k : k + step], m[k : k + step], reach)
        for k in range(0, max(len(e), 1), step)
    ]
    return Overlaps(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _facing(slave: Simplices, master: Simplices, reach: Reach) -> tuple[Nodes, Nodes]:
    """Return pairs of faces (k,) that a ray along a slave normal may connect.

    From the centre of each slave face, in both directions along its normal, a point is
    moved repeatedly by a lower bound on its distance from the master until it is close
    to the centre of a master face.
    """
    from scipy.spatial import KDTree  # takes 0.1 s

    tree = KDTree(master.centre)
    near = slave.radius + master.radius.max()
    limit = reach.max_distance(slave.surface, master.surface) + near
    e: list[Nodes] = []
    m: list[Nodes] = [np.zeros(0, dtype=np.int64)]
    for sign in (1.0, -1.0):
        at, t = slave.centre.copy(), np.zeros(len(near))
        moves = np.ones(len(near), dtype=bool)
        for _ in range(MAX_STEPS):
            d, _ = tree.query(at[moves])
            step = np.where(d > CLOSE * near[moves], d - near[moves], 0.0)
            t[moves] += step
            at[moves] += (sign * step)[:, None] * slave.surface.normal[moves]
            moves[moves] = (step > 0) & (t[moves] <= limit[moves])
            if not moves.any():
                break
        # skip faces whose search in the first direction ended at its start: the search
        # in the second direction would return the same candidates
        start = np.flatnonzero(~moves & (t <= limit) & ((sign > 0) | (t > 0)))
        found = tree.query_ball_point(at[start], MAX_SPREAD * near[start])
        e.append(np.repeat(start, np.array([len(k) for k in found], dtype=int)))
        m.extend(np.asarray(k, dtype=np.int64) for k in found)
    pairs = np.unique(np.stack([np.concatenate(e), np.concatenate(m)]), axis=1)
    offset = master.centre[pairs[1]] - slave.centre[pairs[0]]
    n = slave.surface.normal[pairs[0]]
    across = offset - np.einsum("px,px->p", offset, n)[:, None] * n
    size = slave.radius[pairs[0]] + master.radius[pairs[1]]
    used = np.linalg.norm(across, axis=1) <= size
    used &= np.einsum("px,px->p", n, master.surface.normal[pairs[1]]) <= reach.cosine
    return pairs[0, used], pairs[1, used]


def _integrals(
    slave: Simplices, master: Simplices, e: Nodes, m: Nodes, reach: Reach
) -> Overlaps:
    """Return the integrals over the overlaps of pairs of faces e, m (k,)."""
    t_s, pair = slave.of_facets(e)
    t_m, place = master.of_facets(m[pair])
    # pair all triangles of the slave face with all triangles of the master face
    t_s, pair = t_s[place], pair[place]
    # coordinates in the auxiliary plane, and height above it
    frame = np.concatenate(
        [tangents(slave.surface.normal[e]), slave.surface.normal[e][:, None]], 1
    )
    on_s, on_m = (
        np.einsum(
            "pax,pvx->pva", frame[pair], side.vertices[t] - slave.centre[e[pair], None]
        )
        for side, t in ((slave, t_s), (master, t_m))
    )
    on_m = on_m[:, ::-1]  # corners run clockwise on the plane
    meets = (on_s.max(axis=1) > on_m.min(axis=1))[:, :2].all(axis=1)
    meets &= (on_m.max(axis=1) > on_s.min(axis=1))[:, :2].all(axis=1)
    meets &= _double_area(on_m) > 0
    pair, t_s, t_m, on_s, on_m = (v[meets] for v in (pair, t_s, t_m, on_s, on_m))
    moment = moments(*clip(on_s[..., :2], on_m[..., :2]))
    # functions a + b x + c y on each triangle: barycentric coordinates and heights
    affine_s, affine_m = (np.linalg.inv(_with_ones(on)) for on in (on_s, on_m))
    N = np.einsum("pav,pvc->pca", affine_s, slave.shape[t_s])
    N_m = np.einsum("pav,pvc->pca", affine_m, master.shape[t_m][:, ::-1])
    g = np.einsum("pav,pv->pa", affine_m, on_m[..., 2])
    g -= np.einsum("pav,pv->pa", affine_s, on_s[..., 2])
    weighted = N @ moment
    area = moment[:, 0, 0]
    least = MIN_OVERLAP * slave.radius[e[pair]] ** 2
    mean_gap = np.einsum("pa,pa->p", moment[:, 0], g) / np.where(area > 0, area, 1)
    distance = reach.max_distance(slave.surface, master.surface)
    used = (area > least) & (np.abs(mean_gap) <= distance)
    pairs, place = np.unique(pair[used], return_inverse=True)

    def summed(values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum the integrals of the triangles of each pair of faces."""
        total = np.zeros((len(pairs), *values.shape[1:]))
        np.add.at(total, place, values[used])
        return total

    return Overlaps(
        e[pairs],
        m[pairs],
        summed(weighted[..., 0]),
        summed(weighted @ N.transpose(0, 2, 1)),
        summed(weighted @ N_m.transpose(0, 2, 1)),
        summed((weighted @ g[..., None])[..., 0]),
    )


def _with_ones(triangles: Points) -> NDArray[np.float64]:
    """Return the matrices (p, 3, 3) with rows (1, x, y) of the vertices."""
    rows = np.ones((len(triangles), 3, 3))
    rows[..., 1:] = triangles[..., :2]
    return rows


def clip(subject: Points, window: Points) -> tuple[Points, Nodes]:
    """Clip triangles by triangles (Sutherland and Hodgman 1974).

    Parameters
    ----------
    subject, window : (p, 3, 2) vertices, anticlockwise

    Returns
    -------
    corners (p, 6, 2) of the overlaps, anticlockwise, and the numbers (p,) of corners; 0
    if the triangles do not overlap

    """
    p = len(subject)
    polygon = np.zeros((p, MAX_CORNERS + 1, 2))
    polygon[:, :3], count = subject, np.full(p, 3)
    slot = np.arange(MAX_CORNERS + 1)
    for k in range(3):
        A, B = window[:, k], window[:, (k + 1) % 3]
        edge = B - A
        offset = polygon - A[:, None]
        # d is positive on the inner side, to the left of AB
        d = edge[:, None, 0] * offset[..., 1] - edge[:, None, 1] * offset[..., 0]
        # corners on the line up to rounding count as inside: signs of rounding errors
        # could cause more than two crossings of a convex polygon
        size = (
            np.abs(edge).max(axis=1)[:, None] * np.abs(offset).max(axis=(1, 2))[:, None]
        )
        d[np.abs(d) <= ON_LINE * size] = 0
        exists = slot < count[:, None]
        after = np.where(slot + 1 < count[:, None], slot + 1, 0)
        end = np.take_along_axis(polygon, after[..., None], axis=1)
        d_end = np.take_along_axis(d, after, axis=1)
        inside = exists & (d >= 0)
        crosses = exists & ((d >= 0) != (d_end >= 0))
        t = d / np.where(crosses, d - d_end, 1.0)
        crossing = polygon + t[..., None] * (end - polygon)
        # each corner is followed by the crossing of its edge
        emitted = np.stack([inside, crosses], axis=2).reshape(p, 2 * slot.size)
        corners = np.stack([polygon, crossing], axis=2).reshape(*emitted.shape, 2)
        place = np.cumsum(emitted, axis=1) - 1
        count = emitted.sum(axis=1)
        i, j = np.nonzero(emitted)
        polygon = np.zeros_like(polygon)
        polygon[i, place[i, j]] = corners[i, j]
    return polygon[:, :MAX_CORNERS], count


def moments(polygon: Points, count: Nodes) -> NDArray[np.float64]:
    """Return ∫ww^T (p, 3, 3) for w = (1, x, y) over anticlockwise polygons.

    The integral is a sum over the triangles between the first corner and each edge. On
    a triangle of area A with vertices v_i (as w) and their sum s,
    ∫ww^T = A (Σ v_i v_i^T + ss^T) / 12.

    polygon : (p, k, 2) corners
    count : (p,) number of corners in use, which come first
    """
    first = polygon[:, :1]
    total = np.zeros((len(polygon), 3, 3))
    for i in range(1, polygon.shape[1] - 1):
        triangle = np.concatenate([first, polygon[:, i : i + 2]], axis=1)
        area = np.where(i + 1 < count, _double_area(triangle) / 2, 0.0)
        w = _with_ones(triangle)
        s = w.sum(axis=1)
        squares = w.transpose(0, 2, 1) @ w + s[:, :, None] * s[:, None]
        total += (area / 12)[:, None, None] * squares
    return total


def _double_area(triangle: Points) -> Vector:
    """Return twice the areas (p,) of triangles (p, 3, 2), negative if clockwise."""
    a, b = triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0]
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _dual(at: Overlaps) -> NDArray[np.float64]:
    """Return A = D_e M_e⁺ (p, 4, 4) of the slave face of each overlap."""
    faces, place = np.unique(at.slave, return_inverse=True)
    M_e = np.zeros((len(faces), *at.own.shape[1:]))
    D_e = np.zeros((len(faces), at.own.shape[1]))
    np.add.at(M_e, place, at.own)
    np.add.at(D_e, place, at.area)
    inverse = np.linalg.pinv(M_e, rcond=SINGULAR, hermitian=True)
    return np.asarray((D_e[..., None] * inverse)[place])
