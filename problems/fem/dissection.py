"""Nested dissection of a mesh: elimination order of a sparse Cholesky factorisation.

A set of nodes is bisected at the median of the coordinate along which it is longest, in
the principal axes of its connected component (recursive coordinate bisection, Berger
and Bokhari, IEEE Trans. Comput. 36, 1987). The nodes of the second half with a
neighbour in the first half form the separator, which is eliminated after both halves.
The halves are bisected recursively down to LEAF_SIZE nodes (George, SIAM J. Numer.
Anal. 10, 1973). Selected nodes are eliminated last, so that the trailing block of the
factor is the Cholesky factor of the Schur complement on these nodes.

Leaves, separators and the selected nodes of each connected component, each eliminated
as a whole, are the fronts of a multifrontal factorisation
(`problems.fem.multifrontal`), in postorder: a separator comes after both of its halves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from mortarbench.harness import Matrix
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.fem.ordering import borders, dissect_components

LEAF_SIZE = 8  #: sets of at most this many nodes are not bisected further
#: entries of a matrix of inertia below this fraction of its trace count as rounding
INERTIA_ROUNDING = 1e-9

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
    d = K.shape[0] // len(points)
    graph = csr_array((K.data, K.indices, K.indptr), shape=K.shape).tobsr((d, d))
    ptr, idx = index_arrays(graph)
    pattern = csr_array((np.ones(idx.size), idx, ptr))
    count, component = connected_components(pattern, directed=False)
    key = 2 * component
    key[last] += 1
    x = np.empty_like(points)
    for c in range(count):
        x[component == c] = _principal(points[component == c])
    order, start, children, roots = dissect_components(ptr, idx, x, key, LEAF_SIZE)
    first, border = borders(ptr, idx, order, start, children)
    return order.astype(np.int64), Fronts(start, first, border, children, roots)


def _principal(points: Floats) -> Floats:
    """Return the coordinates (N, dim) of points along their principal axes.

    Products of inertia that are due to rounding count as zero, so that a cube keeps its
    axes.
    """
    x = points - points.mean(axis=0)
    inertia = x.T @ x
    inertia[np.abs(inertia) < INERTIA_ROUNDING * np.trace(inertia)] = 0
    return np.asarray(x @ np.linalg.eigh(inertia)[1])


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
