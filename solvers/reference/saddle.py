"""Saddle-point systems [P + D Bᵀ; B −W] with D, W > 0 diagonal, by LU factors.

Where P is positive semidefinite, such a matrix is quasidefinite: it is regular, and a
sparse one has triangular factors in every symmetric order of its rows (Vanderbei 1995,
SIAM J. Optim. 5), hence the order is that of least fill, without pivoting. Where D and
W are so small that rounding spoils such factors, pivots are chosen by size.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import lu_solve
from scipy.linalg.lapack import dgetrf
from scipy.sparse import block_array, csc_array, diags_array
from scipy.sparse.linalg import splu

from harness import Matrix, Vector

#: for `splu`
LEAST_FILL = dict(
    permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=dict(SymmetricMode=True)
)
PIVOTED = dict(permc_spec="COLAMD", diag_pivot_thresh=1.0)
GOOD = 1e-6  #: residual of a solve that refinement soon makes as small as rounding

Solve = Callable[[Vector, Vector], tuple[Vector, Vector]]


def saddle(P: Matrix, B: Matrix, D: Vector, W: Vector) -> Solve:
    """Factorise; give what solves for (u, v) with (r, t) on the right.

    Parameters
    ----------
    P : (n, n), and B : (r, n), both dense or both sparse
    D : (n,) and W : (r,), positive

    Raises
    ------
    ArithmeticError
        When an entry is not finite, or a pivot vanishes.

    """
    if not (np.isfinite(D).all() and np.isfinite(W).all()):
        raise ArithmeticError("the saddle-point matrix holds numbers beyond all bounds")
    K = _dense(P, B, D, W) if isinstance(P, np.ndarray) else _sparse(P, B, D, W)
    once = _factorised(K)
    n = D.size

    def solve(r: Vector, t: Vector) -> tuple[Vector, Vector]:
        right = np.concatenate([r, t])
        w = once(right)
        w += once(right - K @ w)
        return w[:n], w[n:]

    return solve


def _dense(P: Matrix, B: Matrix, D: Vector, W: Vector) -> Matrix:
    n, r = D.size, W.size
    K = np.empty((n + r, n + r))
    K[:n, :n], K[:n, n:], K[n:, :n], K[n:, n:] = P, B.T, B, 0.0
    K[np.arange(n), np.arange(n)] += D
    K[n + np.arange(r), n + np.arange(r)] = -W
    return K


def _sparse(P: Matrix, B: Matrix, D: Vector, W: Vector) -> Matrix:
    if not W.size:
        return csc_array(P + diags_array(D))
    return csc_array(block_array([[P + diags_array(D), B.T], [B, diags_array(-W)]]))


def _factorised(K: Matrix) -> Callable[[Vector], Vector]:
    if not K.shape[0]:
        return np.copy
    if isinstance(K, np.ndarray):
        factor, pivots, info = dgetrf(K)
        if info:
            raise ArithmeticError("the saddle-point matrix is singular")
        return lambda v: np.asarray(lu_solve((factor, pivots), v, check_finite=False))
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
