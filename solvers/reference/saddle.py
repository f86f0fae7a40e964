"""Saddle-point systems [P + D Bᵀ; B −W] with D, W > 0 diagonal, by LU factors.

Where P is positive semidefinite, such a matrix is quasidefinite: it is regular, and a
sparse one has triangular factors in every symmetric order of its rows (Vanderbei 1995,
SIAM J. Optim. 5), hence the order is that of least fill, without pivoting. Where D and
W are so small that rounding spoils such factors, pivots are chosen by size.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg.lapack import dgetrf, dgetrs
from scipy.sparse import block_array, csc_array, diags_array
from scipy.sparse.linalg import splu

from mortarbench.harness import Matrix, Vector

#: for `splu`
LEAST_FILL = dict(
    permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=dict(SymmetricMode=True)
)
PIVOTED = dict(permc_spec="COLAMD", diag_pivot_thresh=1.0)
GOOD = 1e-6  #: residual of a solve that refinement soon makes as small as rounding

Solve = Callable[[Vector, Vector], tuple[Vector, Vector]]
Factorise = Callable[[Vector, Vector], Solve]


def saddle(P: Matrix, B: Matrix) -> Factorise:
    """Give what factorises [P + D Bᵀ; B −W] for D (n,) and W (r,), both positive.

    What that returns solves for (u, v) with (r, t) on the right. It raises
    ArithmeticError where an entry is not finite, or a pivot vanishes.

    P : (n, n), and B : (r, n), both dense or both sparse
    """
    n = P.shape[0]
    with_diagonal = _dense(P, B) if isinstance(P, np.ndarray) else _sparse(P, B)

    def factorised(D: Vector, W: Vector) -> Solve:
        if not (np.isfinite(D).all() and np.isfinite(W).all()):
            raise ArithmeticError(
                "the saddle-point matrix holds numbers beyond all bounds"
            )
        K = with_diagonal(np.append(D, -W))
        once = _factorised(K)

        def solve(r: Vector, t: Vector) -> tuple[Vector, Vector]:
            right = np.concatenate([r, t])
            w = once(right)
            w += once(right - K @ w)
            return w[:n], w[n:]

        return solve

    return factorised


def _dense(P: Matrix, B: Matrix) -> Callable[[Vector], Matrix]:
    """Give the map from d (n + r,) to [P Bᵀ; B 0] + diag(d)."""
    n, r = P.shape[0], B.shape[0]
    base, every = np.zeros((n + r, n + r)), np.arange(n + r)
    base[:n, :n], base[:n, n:], base[n:, :n] = P, B.T, B

    def plus(d: Vector) -> Matrix:
        K = base.copy()
        K[every, every] += d
        return K

    return plus


def _sparse(P: Matrix, B: Matrix) -> Callable[[Vector], Matrix]:
    """Do so for sparse matrices, whose diagonal is stored."""
    size = P.shape[0] + B.shape[0]
    base = csc_array(block_array([[P, B.T], [B, None]])) if B.shape[0] else P
    values = base.diagonal()
    base = csc_array(base + diags_array(np.where(values == 0, 1.0, values)))
    base.sort_indices()
    columns = np.repeat(np.arange(size), np.diff(base.indptr))
    diagonal = np.flatnonzero(base.indices == columns)

    def plus(d: Vector) -> Matrix:
        data = base.data.copy()
        data[diagonal] = values + d
        return csc_array((data, base.indices, base.indptr), shape=base.shape)

    return plus


def _factorised(K: Matrix) -> Callable[[Vector], Vector]:
    if not K.shape[0]:
        return np.copy
    if isinstance(K, np.ndarray):
        factor, pivots, info = dgetrf(K)
        if info:
            raise ArithmeticError("the saddle-point matrix is singular")
        return lambda v: np.asarray(dgetrs(factor, pivots, v)[0])
    for order in (LEAST_FILL, PIVOTED):
        try:
            lu = splu(K, **order)
        except RuntimeError:  # a pivot is zero
            continue
        if order is PIVOTED or _solves(lu.solve, K):
            return lambda v, lu=lu: np.asarray(lu.solve(v))  # type: ignore[misc]
    raise ArithmeticError("the saddle-point matrix is singular")


def _solves(solve: Callable[[Vector], Vector], K: Matrix) -> bool:
    """Whether refinement with these factors converges, tried on one right side."""
    v = K @ np.linspace(1, 2, K.shape[0])
    return bool(np.abs(K @ solve(v) - v).max() <= GOOD * np.abs(v).max())
