"""Contact rows B u ≤ c of one or several pairs of sides, and operations on them.

Every slave node has at most one row per pair. If several pairs have the same row at a
common slave node, such as where two named parts of a side meet, this row has a single
multiplier, and its force is divided among the pairs in proportion to the areas by which
they cover the node.

*Border of the master.* The row of a slave node acts between the node and its closest
point on the master. If the node is beyond the border of the master, the line between
the two points is not normal to the master, and the forces of such a row would have a
moment. Two rules keep the forces in equilibrium:

- Up to `EXTENSION` beyond the border, the node is opposite the extended plane of the
  master's last facet (as in the extension zone of Abaqus).
- If a facet of the slave has a node farther beyond, the rows of its nodes contain the
  integral over the part of the facet that the master covers. With the basis N_j of
  mortar contact, the row of node j is

      Σ_e ∫_e N_j g  ≥  0,   where  ∫_e N_j g ≈ g_j ∫_e N_j  on all other facets.

A node of which the master covers less than `MIN_COVER` times the area that it covers of
a neighbour has no row, because its row would hardly differ from that of the neighbour.
At a straight border, this applies to nodes more than nine tenths of a facet beyond. In
the integrals, N_j is added to the functions of the nodes with a row in its facets, so
that the functions of all rows sum to one, and the areas of all rows to the covered
area.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array, eye_array, kron, vstack

from mortarbench.harness import Vector
from mortarbench.problems.contact.surface import Points, Surface
from mortarbench.problems.fem.mesh import Nodes, dofs_of

#: distance by which a slave node may be beyond the border of its master and still have
#: a nodal row, relative to the smaller radius of a facet of both sides: a tenth of the
#: length of a segment, the default of Abaqus
EXTENSION = 0.2
#: smallest ratio of the covered areas of neighbouring slave nodes with integral rows.
#: On a uniform chain, the ratio is (θ²/2) / (1/2 + θ − θ²/2) if the fraction θ of the
#: last segment is covered: 1/100 for θ = 0.1
MIN_COVER = 1 / 100
#: two rows of a slave node are the same if their entries differ by at most this value,
#: and their gaps by at most this fraction of the size of the bodies
SAME_ROW = 1e-9
#: entries of a row at free components whose sum is at most this fraction of the sum of
#: all entries count as rounding errors of the normal
MIN_FREE = 1e-12


class ContactRows(NamedTuple):
    """Contact rows B u ≤ c for the total displacement u, and rows of the slip T u.

    The last four arrays have one entry for each slave node with a row (for each pair).
    """

    B: csr_array  #: (m, n) B_M of eq. (5), dimensionless
    c: Vector  #: (m,) c_M of eq. (5), m
    T: csr_array  #: (k, n) tangential rows, dim − 1 per contact row with friction
    row: Nodes  #: (k,) contact row of each tangential row
    #: (e,) ∫N_j over the slave side (for mortar contact, over its covered part, and
    #: with the weight |ν| in 2D), the length in m (2D) or the area in m² (3D) that is
    #: assigned to the row
    share: Vector
    #: (e,) index of the slave node in `ContactPair.slave_nodes`; with several pairs, in
    #: the concatenation of these arrays
    place: Nodes
    #: (e,) fraction of the node's length or area that is opposite the master
    covered: Vector
    at: Nodes  #: (e,) contact row of each entry

    def of_rows(self, values: Vector) -> Vector:
        """Return the sums (m,) over the slave nodes of each row.

        values : (e,) value of each entry
        """
        return np.bincount(self.at, values, minlength=self.c.size).astype(float)

    def at_places(self, force: Vector, places: int) -> Vector:
        """Return the force (places,) of each slave node; zero if it has no row.

        force : (m,) force of each row, which is divided in proportion to `share`
        """
        at_place = np.zeros(places)
        share = self.share / self.of_rows(self.share)[self.at]
        at_place[self.place] = force[self.at] * share
        return at_place

    def resultants(self, nodes: Nodes, dim: int) -> Points:
        """Return the sums (m, dim) of the entries of each row at some nodes."""
        sums = [self.B[:, dofs_of(nodes, dim, axis)].sum(axis=1) for axis in range(dim)]
        return np.stack(sums, axis=1)

    def selected(self, keep: NDArray[np.bool_]) -> ContactRows:
        """Return the rows in a mask (m,), with their tangential rows and entries."""
        number = np.cumsum(keep) - 1
        slips, entries = keep[self.row], keep[self.at]
        return ContactRows(
            self.B[keep],
            self.c[keep],
            self.T[slips],
            number[self.row[slips]],
            self.share[entries],
            self.place[entries],
            self.covered[entries],
            number[self.at[entries]],
        )


def with_integrals(
    nodal: ContactRows,
    side: Surface,
    outside: NDArray[np.bool_],
    integral: Callable[..., ContactRows],
) -> ContactRows:
    """Integrate over the slave facets with a node beyond the border of the master.

    Parameters
    ----------
    nodal : rows of all slave nodes
    outside : (s,) mask of the nodes beyond the border
    integral : function that returns the mortar rows, with the basis N_j, of the slave
        facets in a mask `part` (f,)

    """
    s, areas = nodal.c.size, side.areas
    cut = np.asarray(outside[side.facets].any(axis=1))
    whole = areas.copy()
    bordered = np.unique(side.facets[cut])
    whole[bordered] = side.areas_in(~cut)[bordered]
    whole[outside] = 0.0
    part = without_barely_covered(integral(part=cut), side.facets[cut], areas, whole)
    covered = np.zeros((2, s))  # ∫N_j on the cut facets, as in `share` and in `covered`
    covered[:, part.place] = part.share, part.covered * areas[part.place]
    # the rows are V · nodal + W · part, with weights that sum to one
    kept = whole + covered[0] > 0
    total = np.where(kept, whole + covered[0], 1.0)
    V = diags_array(whole / total)
    weight = part.share / total[part.place]
    shape = (s, part.place.size)
    W = csr_array((weight, (part.place, np.arange(part.place.size))), shape=shape)
    one = eye_array(nodal.T.shape[0] // s)
    area = whole + covered[1]
    B = csr_array(V @ nodal.B + W @ part.B)
    T = csr_array(kron(V, one) @ nodal.T + kron(W, one) @ part.T)
    for matrix in (B, T):
        matrix.sort_indices()
    return ContactRows(
        B=B,
        c=V @ nodal.c + W @ part.c,
        T=T,
        row=nodal.row,
        share=area,
        place=nodal.place,
        covered=area / areas,
        at=nodal.at,
    ).selected(kept)


def without_barely_covered(
    rows: ContactRows, facets: Nodes, areas: Vector, elsewhere: Vector
) -> ContactRows:
    """Add the functions N_j of nodes that the master barely covers to their neighbours.

    Parameters
    ----------
    rows : integral rows, one for each covered node
    facets : (f, a) facets of the slave side, as indices into its s nodes
    areas, elsewhere : (s,) areas of the nodes, and the covered part of these areas that
        is not in `rows`

    """
    place, covered = rows.place, np.zeros(areas.size)
    covered[place] = rows.covered * areas[place]
    kept = (covered > 0) & ~barely_covered(covered + elsewhere, facets, MIN_COVER)
    E = handed_over(facets, kept)[kept][:, place]
    share = E @ rows.share
    W = csr_array(diags_array(1 / share) @ E @ diags_array(rows.share))
    per_row, every = rows.T.shape[0] // max(place.size, 1), np.arange(share.size)
    return ContactRows(
        B=csr_array(W @ rows.B),
        c=W @ rows.c,
        T=csr_array(kron(W, eye_array(per_row)) @ rows.T),
        row=np.repeat(every, per_row),
        share=share,
        place=np.flatnonzero(kept),
        covered=E @ covered[place] / areas[kept],
        at=every,
    )


def barely_covered(covered: Vector, facets: Nodes, ratio: float) -> NDArray[np.bool_]:
    """Return the mask (s,) of nodes with a small covered area beside a larger one.

    Parameters
    ----------
    covered : (s,) covered area of each node
    facets : (f, a) facets of the side
    ratio : smallest ratio of the areas of neighbours that does not count as small

    """
    most = np.zeros(covered.size)
    np.maximum.at(most, facets, covered[facets].max(axis=1, keepdims=True))
    return np.asarray(covered < ratio * most)


def handed_over(facets: Nodes, kept: NDArray[np.bool_]) -> csr_array:
    """Return E (s, s), which adds values of nodes to those of kept nodes.

    The value of a node that is not kept is divided equally among the kept nodes in its
    facets; values of kept nodes do not change.

    Parameters
    ----------
    facets : (f, a) facets of the side
    kept : (s,) mask of the nodes

    """
    i = np.repeat(facets, facets.shape[1], axis=1).ravel()
    j = np.tile(facets, (1, facets.shape[1])).ravel()
    given, shape = kept[i] & ~kept[j], (kept.size, kept.size)
    E = csr_array((np.ones(given.sum()), (i[given], j[given])), shape=shape)
    E.data[:] = 1.0
    E.data /= np.bincount(E.indices, minlength=kept.size)[E.indices]
    return csr_array(E + diags_array(kept.astype(float)))


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


def side_matrix(
    blocks: NDArray[np.float64], rows: Nodes, nodes: Nodes, shape: tuple[int, int]
) -> csr_array:
    """Sum blocks (p, a, c, dim) at rows (p, a) and nodes (p, c) into a matrix.

    shape : numbers of rows and of nodes; each node has dim columns
    """
    dim = blocks.shape[-1]
    row = np.broadcast_to(rows[:, :, None, None], blocks.shape)
    column = np.broadcast_to(
        dim * nodes[:, None, :, None] + np.arange(dim), blocks.shape
    )
    at = row.ravel(), column.ravel()
    return csr_array(coo_array((blocks.ravel(), at), (shape[0], dim * shape[1])))


def mortar_rows(
    D: csr_array, M: csr_array, cover: Vector, sides: tuple[Nodes, Nodes], n: int
) -> csr_array:
    """Return the rows (m, n) of u ↦ (D u_s − M u_m)_j / cover_j for j with cover_j > 0.

    D, M : (s, dim·s) and (s, dim·v), from `side_matrix`
    sides : numbers of the slave nodes (s,) and of the master nodes (v,)
    """
    j, dim = np.flatnonzero(cover), D.shape[1] // max(D.shape[0], 1)
    left, right = D[j].tocoo(), M[j].tocoo()
    row = np.concatenate([left.row, right.row])
    slave, master = (dofs_of(side, dim) for side in sides)
    column = np.concatenate([slave[left.col], master[right.col]])
    values = np.concatenate([left.data, -right.data]) / cover[j][row]
    B = csr_array(coo_array((values, (row, column)), (len(j), n)))
    B.eliminate_zeros()
    return B


def gathered(values: NDArray[np.float64], nodes: Nodes, count: int) -> Vector:
    """Sum values (p, a) at nodes (p, a) into a vector (count,)."""
    return np.bincount(nodes.ravel(), values.ravel(), minlength=count).astype(float)


def joined(
    parts: Sequence[ContactRows], nodes: Sequence[Nodes], size: float
) -> ContactRows:
    """Join the rows of several pairs; equal rows of a common slave node become one.

    nodes : slave nodes of each pair
    size : size of the bodies, relative to which gaps are compared, m
    """
    first_row = np.cumsum([0, *(part.c.size for part in parts)])
    first_place = np.cumsum([0, *(one.size for one in nodes)])

    def numbered(name: str, first: Nodes) -> Nodes:
        values = (getattr(p, name) + k for p, k in zip(parts, first, strict=False))
        return np.concatenate(list(values))

    rows = ContactRows(
        B=csr_array(vstack([part.B for part in parts])),
        c=np.concatenate([part.c for part in parts]),
        T=csr_array(vstack([part.T for part in parts])),
        row=numbered("row", first_row),
        share=np.concatenate([part.share for part in parts]),
        place=numbered("place", first_place),
        covered=np.concatenate([part.covered for part in parts]),
        at=numbered("at", first_row),
    )
    # sort by slave node, so that rows of a common node follow each other
    node = np.concatenate(list(nodes))[rows.place]
    order = np.argsort(node, kind="stable")
    before, after = rows.at[order[:-1]], rows.at[order[1:]]
    common = np.flatnonzero(node[order[:-1]] == node[order[1:]])
    i, j = before[common], after[common]
    slips = np.isin(np.arange(rows.c.size), rows.row)
    same = np.full(common.size, False)
    if common.size:
        same = abs(rows.B[i] - rows.B[j]).max(axis=1).toarray().ravel() <= SAME_ROW
        same &= np.abs(rows.c[i] - rows.c[j]) <= SAME_ROW * size
        same &= slips[i] == slips[j]  # otherwise the friction of one would be lost
    leader = np.arange(rows.c.size)
    for first, second in zip(i[same], j[same], strict=True):
        leader[second] = leader[first]
    keep = leader == np.arange(leader.size)
    return rows._replace(at=leader[rows.at]).selected(keep)


def without_fixed(rows: ContactRows, fixed: Nodes) -> ContactRows:
    """Return the rows with an entry at a free component.

    If supports prescribe all components of a row, its multiplier is a force between
    supports, which no equation determines.

    fixed : components that supports prescribe
    """
    free = np.ones(rows.B.shape[1])
    free[fixed] = 0.0
    size = abs(rows.B)
    return rows.selected(size @ free > MIN_FREE * size.sum(axis=1))
