"""Nested dissection of a mesh: elimination order of a sparse Cholesky factorisation.

A set of nodes is bisected across its longest principal axis. The nodes of the second
half with a neighbour in the first half form the separator, which is eliminated after
both halves. The halves are bisected recursively down to LEAF_SIZE nodes (George, SIAM
J. Numer. Anal. 10, 1973; bisection by coordinates as in Gilbert, Miller and Teng, SIAM
J. Sci. Comput. 19, 1998). Selected nodes are eliminated last, so that the trailing
block of the factor is the Cholesky factor of the Schur complement on these nodes.

Leaves, separators and the selected nodes of each connected component, each eliminated
as a whole, are the fronts of a multifrontal factorisation
(`problems.fem.multifrontal`), in postorder: a separator comes after both of its halves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Matrix
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.fem.ordering import borders, dissect_components, node_graph

LEAF_SIZE = 8  #: sets of at most this many nodes are not bisected further

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Marks = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Fronts:
    """Fronts: sets of positions in the elimination order, in postorder of their tree.

    Front s eliminates the positions start[s] … start[s + 1] − 1. The border of s,
    border[first[s]:first[s + 1]], lists the later positions with nonzeros (including
    fill-in) in the rows of s, ascending. The children of s are the last `children[s]`
    fronts before s that are not children of an earlier front.
    """

    start: Ints  #: (F + 1,) first position of each front
    first: Ints  #: (F + 1,) start of the border of each front in `border`
    border: Ints  #: borders of all fronts
    children: Ints  #: (F,) number of children of each front
    roots: Marks  #: (F,) True for fronts of the nodes that are eliminated last


def dissect(K: Matrix, points: Floats, last: Nodes) -> tuple[Nodes, Fronts]:
    """Compute an elimination order (N,) of the nodes of a mesh, and its fronts.

    Parameters
    ----------
    K : (dN, dN) symmetric pattern in CSC; node i has the d components d·i, d·i + 1, …
    points : (N, dim) positions of the nodes
    last : nodes that are eliminated after all others of their connected component

    Returns
    -------
    the nodes in elimination order, and the fronts, which are sets of positions in this
    order

    """
    nodes = len(points)
    ptr, idx = node_graph(*index_arrays(K), K.shape[0] // nodes, nodes)
    is_last = np.zeros(nodes, dtype=np.bool_)
    is_last[last] = True
    order, start, children, roots = dissect_components(
        ptr, idx, points, is_last, LEAF_SIZE
    )
    first, border = borders(ptr, idx, order, start, children)
    return order.astype(np.int64), Fronts(start, first, border, children, roots)


def expand_positions(fronts: Fronts, ends: Ints) -> Fronts:
    """Replace each position i by the positions ends[i] … ends[i + 1] − 1, or none."""
    count = np.diff(ends)[fronts.border]
    above = np.append(0, np.cumsum(count))
    each = np.arange(above[-1]) - np.repeat(above[:-1], count)
    return Fronts(
        ends[fronts.start],
        above[fronts.first].astype(np.int32),
        (np.repeat(ends[fronts.border], count) + each).astype(np.int32),
        fronts.children,
        fronts.roots,
    )


def index_arrays(A: Matrix) -> tuple[Ints, Ints]:
    """Return indptr and indices of a CSC or CSR matrix as 32-bit integers."""
    return A.indptr.astype(np.int32, copy=False), A.indices.astype(np.int32, copy=False)
