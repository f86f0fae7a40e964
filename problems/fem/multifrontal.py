"""Sparse Cholesky factors by the multifrontal method (Duff and Reid 1983; Liu 1992).

Each front assembles a small dense matrix from the entries of K in its rows and the
Schur complements of its children, eliminates the unknowns of the front, and passes the
Schur complement on its border to its parent. Nearly all work is in dense products (Liu,
SIAM Review 34, 1992).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Matrix, Vector
from mortarbench.problems.fem.dissection import (
    Fronts,
    dissect,
    expand_positions,
    index_arrays,
)
from mortarbench.problems.fem.elimination import eliminate, substitute
from mortarbench.problems.fem.mesh import Nodes

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Multifrontal:
    """Factor L of K_oo = LLᵀ; the rows of U = Lᵀ are stored front by front.

    A front with p pivots and a border of b positions has p × (p + b) entries.
    """

    order: Nodes  #: components o in elimination order
    fronts: Fronts  #: fronts of positions in `order`
    offset: NDArray[np.int64]  #: (F + 1,) start of each front in `rows`
    rows: Floats  #: entries of U, front by front

    def solve(self, b: Vector) -> Vector:
        """Solve K_oo x = b for one right-hand side (o,) or several (o, k)."""
        f = self.fronts
        x = np.array(np.atleast_2d(b.T), order="C")
        substitute(f.start, f.first, f.border, self.offset, self.rows, x)
        return x.T.reshape(b.shape)

    def trailing(self) -> list[tuple[Nodes, Floats]]:
        """Return the last unknowns of each connected component and their block of U."""
        f, blocks = self.fronts, []
        for s in np.flatnonzero(f.roots):
            positions = slice(f.start[s], f.start[s + 1])
            rows = self.rows[self.offset[s] : self.offset[s + 1]]
            size = positions.stop - positions.start
            blocks.append((self.order[positions], rows.reshape(size, size)))
        return blocks


def multifrontal(
    K: Matrix, free: Nodes, points: NDArray[np.float64], last: Nodes
) -> Multifrontal:
    """Factorise K_ff in nested dissection order, eliminating the nodes of `last` last.

    Parameters
    ----------
    K : (n, n) symmetric, CSC
    free : components f in K_ff
    points : (N, dim) positions of the nodes; node i has n/N components, the first of
        which is i·n/N
    last : components whose nodes are eliminated last. Distant nodes that K couples
        should belong to `last`, to limit fill-in

    Raises
    ------
    numpy.linalg.LinAlgError
        If K_ff is not positive definite.

    """
    n, N = K.shape[0], len(points)
    nodes, of_nodes = dissect(K, points, last // (n // N))
    acts = np.zeros(n, dtype=np.bool_)
    acts[free] = True
    acting = acts.reshape(N, -1)[nodes]
    order = np.arange(n).reshape(N, -1)[nodes][acting]
    ends = np.append(0, np.cumsum(acting.sum(axis=1))).astype(np.int32)
    fronts = expand_positions(of_nodes, ends)

    position = np.full(n, -1, dtype=np.int32)
    position[order] = np.arange(order.size, dtype=np.int32)
    pivots, border = np.diff(fronts.start), np.diff(fronts.first)
    offset = np.append(0, np.cumsum(pivots.astype(np.int64) * (pivots + border)))
    rows = np.zeros(offset[-1])
    definite = eliminate(
        *index_arrays(K),
        K.data,
        order,
        position,
        fronts.start,
        fronts.first,
        fronts.border,
        fronts.children,
        offset,
        rows,
    )
    if not definite:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    return Multifrontal(order, fronts, offset, rows)
