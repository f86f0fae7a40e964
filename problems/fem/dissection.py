"""Nested dissection of a mesh: in which order a sparse Cholesky factor eliminates it.

A set of nodes is cut in two across its longest principal axis; of the second half, the
nodes with a neighbour in the first separate the two, and are eliminated after both.
Either half is cut again until few nodes are left (George, SIAM J. Numer. Anal. 10,
1973; the cuts by coordinates, as in Gilbert, Miller and Teng, SIAM J. Sci. Comput. 19,
1998). Chosen nodes are eliminated last of all, so that the trailing block of the factor
is the Schur complement on them.

The sets that are eliminated together, leaves and separators, are the fronts of a
multifrontal factorisation (`problems.fem.multifrontal`), in postorder: both halves come
before what separates them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Matrix
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.fem.ordering import borders, dissect_components, node_graph

LEAF_SIZE = 8  #: nodes that are cut no more

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Marks = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Fronts:
    """Sets of positions in an order of elimination, in postorder of their tree.

    Positions number the eliminated in their order. Those of front s are
    start[s] … start[s + 1] − 1; border[first[s]:first[s + 1]] are the later ones that
    the matrix or the elimination of earlier ones couples with them, ascending. The
    `children[s]` roots of subtrees that come last before s are its children.
    """

    start: Ints  #: (F + 1,)
    first: Ints  #: (F + 1,)
    border: Ints
    children: Ints  #: (F,)
    roots: Marks  #: (F,) which of them hold the nodes to be eliminated last


def dissect(K: Matrix, points: Floats, last: Nodes) -> tuple[Nodes, Fronts]:
    """Order the nodes (N,) of a mesh, and find the fronts of this order.

    Parameters
    ----------
    K : (dN, dN) symmetric pattern in CSC; node i has the d components d·i, d·i + 1, …
    points : (N, 2) of the nodes
    last : nodes that come last in their connected component

    Returns
    -------
    the nodes in order of elimination, and the fronts of their positions in it

    """
    nodes = len(points)
    ptr, idx = node_graph(*index_arrays(K), K.shape[0] // nodes, nodes)
    ending = np.zeros(nodes, dtype=np.bool_)
    ending[last] = True
    order, start, children, roots = dissect_components(
        ptr, idx, points, ending, LEAF_SIZE
    )
    first, border = borders(ptr, idx, order, start, children)
    return order.astype(np.int64), Fronts(start, first, border, children, roots)


def expand_positions(fronts: Fronts, ends: Ints) -> Fronts:
    """Replace each position by several, or none: i by ends[i] … ends[i + 1] − 1."""
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
