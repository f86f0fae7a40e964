"""Sparse Cholesky factors by the multifrontal method (Duff and Reid 1983; Liu 1992).

Each front eliminates its own unknowns from a small dense matrix, made of their entries
of K and of what the fronts below it left, and leaves the Schur complement on its border
to the front above. So the work is that of dense products (Liu, SIAM Review 34, 1992).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from harness import Matrix, Vector
from problems.fem.dissection import Fronts, dissect, spread
from problems.fem.mesh import Nodes

PANEL = 32  #: rows that are factorised before the others are updated by a product
BLOCK = 64  #: rows of a symmetric product that are done at once

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Multifrontal:
    """K_oo = LLᵀ with L stored by fronts: U = Lᵀ of each, own rows × (own + border)."""

    order: Nodes  #: o, components in the order of elimination
    fronts: Fronts  #: of these
    offset: NDArray[np.int64]  #: (F + 1,) where the rows of each front begin in `rows`
    rows: Floats

    def solve(self, b: Vector) -> Vector:
        """Solve K_oo x = b for one right-hand side (o,) or several (o, k)."""
        f = self.fronts
        x = np.array(np.atleast_2d(b.T))
        substitute(f.start, f.first, f.border, self.offset, self.rows, x)
        return x.T.reshape(b.shape)

    def trailing(self) -> list[tuple[Nodes, Floats]]:
        """List the components ordered last in each connected part, and U on them."""
        f, blocks = self.fronts, []
        for s in np.flatnonzero(f.roots):
            own = slice(f.start[s], f.start[s + 1])
            rows = self.rows[self.offset[s] : self.offset[s + 1]]
            size = own.stop - own.start
            blocks.append((self.order[own], rows.reshape(size, size)))
        return blocks


def multifrontal(
    K: Matrix, free: Nodes, points: NDArray[np.float64], last: Nodes
) -> Multifrontal:
    """Factorise K_ff, ordered by nested dissection with the nodes of `last` at the end.

    Parameters
    ----------
    K : (n, n) symmetric, CSC
    free : components f
    points : (N, 2) of the nodes; node i has the n/N components from i·n/N on
    last : components whose nodes come last; only they may be coupled across the mesh

    Raises
    ------
    numpy.linalg.LinAlgError
        When K_ff is not positive definite.

    """
    n, N = K.shape[0], len(points)
    nodes, of_nodes = dissect(K, points, last // (n // N))
    acts = np.zeros(n, dtype=np.bool_)
    acts[free] = True
    acting = acts.reshape(N, -1)[nodes]
    order = np.arange(n).reshape(N, -1)[nodes][acting]
    ends = np.append(0, np.cumsum(acting.sum(axis=1))).astype(np.int32)
    fronts = spread(of_nodes, ends)

    position = np.full(n, -1, dtype=np.int32)
    position[order] = np.arange(order.size, dtype=np.int32)
    own, border = np.diff(fronts.start), np.diff(fronts.first)
    offset = np.append(0, np.cumsum(own.astype(np.int64) * (own + border)))
    rows = np.zeros(offset[-1])
    definite = eliminate(
        K.indptr, K.indices, K.data, order, position, fronts.start, fronts.first,
        fronts.border, fronts.children, offset, rows,
    )  # fmt: skip
    if not definite:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    return Multifrontal(order, fronts, offset, rows)


@njit(cache=True)
def eliminate(
    indptr: Ints, indices: Ints, data: Floats, order: Nodes, position: Ints,
    start: Ints, first: Ints, border: Ints, children: Ints, offset: Nodes, rows: Floats,
) -> bool:  # fmt: skip
    """Write the rows of U front by front; say whether all pivots were positive."""
    place = np.zeros(len(order), dtype=np.int32)  # in the front, of a position
    store = np.empty(_most_waiting(first, children))  # what fronts left, one on another
    waiting, top = [0][:0], 0
    for s in range(len(start) - 1):
        low, own, ahead = (
            start[s],
            start[s + 1] - start[s],
            border[first[s] : first[s + 1]],
        )
        left = len(ahead)
        U = rows[offset[s] : offset[s + 1]].reshape(own, own + left)
        S = store[top : top + left * left].reshape(left, left)
        for i in range(left):
            S[i, i:] = 0
        for p in range(low, low + own):
            place[p] = p - low
        for t in range(left):
            place[ahead[t]] = own + t
        for p in range(low, low + own):
            for t in range(indptr[order[p]], indptr[order[p] + 1]):
                q = position[indices[t]]
                if q >= p:
                    U[p - low, place[q]] = data[t]
        for _ in range(children[s]):
            child = waiting.pop()
            at = border[first[child] : first[child + 1]]
            top -= len(at) ** 2
            below = store[top : top + len(at) ** 2].reshape(len(at), len(at))
            _add(below, place[at], own, U, S)
        if not _factorise_rows(U):
            return False
        _subtract_product(S, U[:, own:].T.copy())
        # to the place of its children, which are done with
        _move(S, store[top : top + left * left].reshape(left, left))
        waiting.append(s)
        top += left * left
    return True


@njit(cache=True)
def _most_waiting(first: Ints, children: Ints) -> int:
    """Count the numbers that `eliminate` has to keep at a time."""
    waiting, top, most = [0][:0], 0, 0
    for s in range(len(children)):
        size = (first[s + 1] - first[s]) ** 2
        most = max(most, top + size)
        for _ in range(children[s]):
            top -= waiting.pop()
        waiting.append(size)
        top += size
    return most


@njit(cache=True)
def _move(S: Floats, to: Floats) -> None:
    """Copy the upper triangle to a place before it, which may overlap it."""
    for i in range(len(S)):
        to[i, i:] = S[i, i:]


@njit(cache=True)
def _add(below: Floats, to: Ints, own: int, U: Floats, S: Floats) -> None:
    """Add the upper triangle of what a child left at the places `to` of its front."""
    for i in range(len(to)):
        if to[i] < own:
            for j in range(i, len(to)):
                U[to[i], to[j]] += below[i, j]
        else:
            for j in range(i, len(to)):
                S[to[i] - own, to[j] - own] += below[i, j]


@njit(cache=True)
def _factorise_rows(U: Floats) -> bool:
    """Turn own rows of a front into those of its factor; False at a pivot ≤ 0."""
    own = len(U)
    for low in range(0, own, PANEL):
        high = min(low + PANEL, own)
        for j in range(low, high):
            _subtract_rows(U, low, j)
            if not U[j, j] > 0:
                return False
            U[j, j:] *= 1 / np.sqrt(U[j, j])
        if high < own:
            columns = U[low:high, high:].T.copy()
            for a in range(0, own - high, BLOCK):
                b = min(a + BLOCK, own - high)
                U[high + a : high + b, high + a :] -= np.dot(
                    columns[a:b], columns[a:].T
                )
    return True


@njit(cache=True, fastmath={"contract"})
def _subtract_rows(U: Floats, low: int, j: int) -> None:
    """Subtract from row j the multiples of rows low … j − 1 that eliminate them."""
    row, p, size = U[j], low, U.shape[1]
    while p + 4 <= j:  # four at once: the row is read and written less often
        u0, u1, u2, u3 = U[p], U[p + 1], U[p + 2], U[p + 3]
        c0, c1, c2, c3 = u0[j], u1[j], u2[j], u3[j]
        for i in range(j, size):
            row[i] -= c0 * u0[i] + c1 * u1[i] + c2 * u2[i] + c3 * u3[i]
        p += 4
    while p < j:
        u0, c0 = U[p], U[p, j]
        for i in range(j, size):
            row[i] -= c0 * u0[i]
        p += 1


@njit(cache=True)
def _subtract_product(S: Floats, columns: Floats) -> None:
    """Subtract the upper triangle of the product of `columns` and its transpose."""
    if not columns.size:
        return
    for a in range(0, len(S), BLOCK):
        b = min(a + BLOCK, len(S))
        product = np.dot(columns[a:b], columns[a:].T)
        for i in range(a, b):
            for j in range(i, len(S)):
                S[i, j] -= product[i - a, j - a]


@njit(cache=True, fastmath={"contract", "reassoc"})
def substitute(
    start: Ints, first: Ints, border: Ints, offset: Nodes, rows: Floats, x: Floats
) -> None:
    """Solve UᵀU x = b in place of b, whose right-hand sides are the rows of x."""
    fronts = len(start) - 1
    v = np.empty(np.max(np.diff(start) + np.diff(first)))
    for t in range(2 * fronts):
        s = min(t, 2 * fronts - 1 - t)  # up the tree and down again
        low, own, ahead = (
            start[s],
            start[s + 1] - start[s],
            border[first[s] : first[s + 1]],
        )
        size = own + len(ahead)
        U = rows[offset[s] : offset[s + 1]].reshape(own, size)
        for k in range(len(x)):
            v[:own] = x[k, low : low + own]
            if t < fronts:
                v[own:size] = 0
                for j in range(own):
                    c = v[j] / U[j, j]
                    v[j] = c
                    for i in range(j + 1, size):
                        v[i] -= c * U[j, i]
                for i in range(own, size):
                    x[k, ahead[i - own]] += v[i]
            else:
                for i in range(own, size):
                    v[i] = x[k, ahead[i - own]]
                for j in range(own - 1, -1, -1):
                    total = 0.0
                    for i in range(j + 1, size):
                        total += U[j, i] * v[i]
                    v[j] = (v[j] - total) / U[j, j]
            x[k, low : low + own] = v[:own]


@njit(cache=True)
def spread_symmetric(upper: Floats, at: Ints, to: Floats) -> None:
    """Write a symmetric matrix, of which the upper triangle is given, at rows `at`.

    Rows and columns whose place is negative are left out.
    """
    for i in range(len(at)):
        if at[i] < 0:
            continue
        for j in range(i, len(at)):
            if at[j] >= 0:
                to[at[i], at[j]] = upper[i, j]
                to[at[j], at[i]] = upper[i, j]
