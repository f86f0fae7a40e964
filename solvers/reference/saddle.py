"""Saddle-point systems [P + D Bᵀ; B −W] with diagonal D, W > 0, solved by LU factors.

If P is positive semidefinite, the matrix is quasidefinite: it is nonsingular and has
triangular factors for every symmetric permutation (Vanderbei 1995, SIAM J. Optim. 5).
A sparse matrix is therefore ordered to reduce fill and factorised without pivoting. If
D and W are so small that these factors are inaccurate because of rounding, partial
pivoting is used instead.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg.lapack import dgetrf, dgetrs
from scipy.sparse import block_array, csc_array, diags_array
from scipy.sparse.linalg import splu

from mortarbench.harness import Matrix, Vector

#: arguments of `splu` for a symmetric fill-reducing ordering without pivoting
LEAST_FILL = dict(
    permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=dict(SymmetricMode=True)
)
PIVOTED = dict(permc_spec="COLAMD", diag_pivot_thresh=1.0)
#: largest relative residual of a solve after which one step of refinement suffices
MAX_SOLVE_RESIDUAL = 1e-6

Solve = Callable[[Vector, Vector], tuple[Vector, Vector]]
Factorise = Callable[[Vector, Vector], Solve]


def saddle(P: Matrix, B: Matrix) -> Factorise:
    """Return a function that factorises [P + D Bᵀ; B −W] for D (n,), W (r,) > 0.

    The resulting function returns the solution operator (r, t) ↦ (u, v). It raises
    ArithmeticError if an entry of D or W is not finite or a pivot is zero.

    P, B : (n, n) and (r, n) matrices, both dense or both sparse
    """
    n = P.shape[0]
    with_diagonal = (
        _dense_matrices(P, B) if isinstance(P, np.ndarray) else _sparse_matrices(P, B)
    )

    def factorise(D: Vector, W: Vector) -> Solve:
        if not (np.isfinite(D).all() and np.isfinite(W).all()):
            raise ArithmeticError("the saddle-point matrix has infinite or NaN entries")
        K = with_diagonal(np.append(D, -W))
        once = _factorise(K)

        def solve(r: Vector, t: Vector) -> tuple[Vector, Vector]:
            right = np.concatenate([r, t])
            w = once(right)
            w += once(right - K @ w)
            return w[:n], w[n:]

        return solve

    return factorise


def _dense_matrices(P: Matrix, B: Matrix) -> Callable[[Vector], Matrix]:
    """Return the function d (n + r,) ↦ [P Bᵀ; B 0] + diag(d)."""
    n, r = P.shape[0], B.shape[0]
    base, every = np.zeros((n + r, n + r)), np.arange(n + r)
    base[:n, :n], base[:n, n:], base[n:, :n] = P, B.T, B

    def plus(d: Vector) -> Matrix:
        K = base.copy()
        K[every, every] += d
        return K

    return plus


def _sparse_matrices(P: Matrix, B: Matrix) -> Callable[[Vector], Matrix]:
    """Return the function d (n + r,) ↦ [P Bᵀ; B 0] + diag(d) in CSC format."""
    size = P.shape[0] + B.shape[0]
    base = csc_array(block_array([[P, B.T], [B, None]])) if B.shape[0] else P
    values = base.diagonal()
    # store every diagonal entry, so that adding d is one update of `data`
    base = csc_array(base + diags_array(np.where(values == 0, 1.0, values)))
    base.sort_indices()
    columns = np.repeat(np.arange(size), np.diff(base.indptr))
    diagonal = np.flatnonzero(base.indices == columns)

    def plus(d: Vector) -> Matrix:
        data = base.data.copy()
        data[diagonal] = values + d
        return csc_array((data, base.indices, base.indptr), shape=base.shape)

    return plus


def _factorise(K: Matrix) -> Callable[[Vector], Vector]:
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
        if order is PIVOTED or _is_accurate(lu.solve, K):
            return lambda v, lu=lu: np.asarray(lu.solve(v))  # type: ignore[misc]
    raise ArithmeticError("the saddle-point matrix is singular")


def _is_accurate(solve: Callable[[Vector], Vector], K: Matrix) -> bool:
    """Return True if the residual of a test system is at most MAX_SOLVE_RESIDUAL."""
    v = K @ np.linspace(1, 2, K.shape[0])
    return bool(np.abs(K @ solve(v) - v).max() <= MAX_SOLVE_RESIDUAL * np.abs(v).max())
