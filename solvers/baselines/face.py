"""Factorised Newton systems of the primal-dual active set method for each face.

Let F be the free components of a face and R its active inequality rows. The Newton step
dx for the right-hand side r is the solution of (M + G_RᵀρG_R)_FF dx_F = r_F and is
computed with a Cholesky factor. M is positive definite, and ρ is the diagonal matrix of
the row penalties. If M is dense and the QP has no inequality rows, the components E
without bounds are eliminated in advance, which costs about as much as one
factorisation. A face then needs only a factor of the free block of the Schur complement
S on the bounded components E̅:

    S = M_E̅E̅ − W ᵀW,   W = L⁻¹M_EE̅,   M_EE = LLᵀ.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular
from scipy.sparse import csc_matrix, diags_array
from sksparse.cholmod import cholesky as sparse_cholesky

from mortarbench.harness import Matrix, Vector

Mask = NDArray[np.bool_]
#: r (n,) ↦ dx (n,), zero outside F; only r_F is used
Solve = Callable[[Vector], Vector]
#: mask of free components (n,), mask of active rows (p,) ↦ solution operator of the
#: face
Faces = Callable[[Mask, Mask], Solve]


def factoriser(M: Matrix, G: Matrix, rho: Vector, always_free: Mask) -> Faces:
    """Return a function that factorises the Newton system of a face.

    M : (n, n) dense or sparse, positive definite
    G, rho : inequality rows (p, n) and their weights (p,)
    always_free : (n,) mask of components without bounds

    Raises
    ------
    numpy.linalg.LinAlgError
        If the block of M that is factorised in advance is not positive definite. If the
        matrix of a face is not positive definite, the returned function raises this
        error, or sksparse.cholmod.CholmodNotPositiveDefiniteError for a sparse M.

    """
    if not isinstance(M, np.ndarray):
        return _sparse(csc_matrix(M), csc_matrix(G), rho)
    if len(rho) or not always_free.any():
        return _dense(M, np.asarray(G), rho)
    return _condensed(M, always_free)


def _sparse(M: csc_matrix, G: csc_matrix, rho: Vector) -> Faces:
    G_rho = csc_matrix(diags_array(rho) @ G)

    def face(free: Mask, active: Mask) -> Solve:
        F = M + G[active].T @ G_rho[active] if active.any() else M
        solve = sparse_cholesky(csc_matrix(F if free.all() else F[free][:, free]))
        return lambda r: _spread(free, solve(r[free]))

    return face


def _dense(M: Vector, G: Vector, rho: Vector) -> Faces:
    def face(free: Mask, active: Mask) -> Solve:
        F = M[np.ix_(free, free)]
        if active.any():
            rows = G[np.ix_(active, free)]
            F += rows.T @ (rho[active, None] * rows)
        factor = _factor(F)
        return lambda r: _spread(free, _solve(factor, r[free]))

    return face


def _condensed(M: Vector, always_free: Mask) -> Faces:
    E, rest = np.flatnonzero(always_free), np.flatnonzero(~always_free)
    L = cholesky(M[np.ix_(E, E)], lower=True, overwrite_a=True, check_finite=False)
    W = solve_triangular(L, M[np.ix_(E, rest)], lower=True, check_finite=False)
    S = M[np.ix_(rest, rest)] - W.T @ W

    def face(free: Mask, active: Mask) -> Solve:
        del active
        free_bounded = np.flatnonzero(free[rest])
        factor, W_F = _factor(S[np.ix_(free_bounded, free_bounded)]), W[:, free_bounded]

        def solve(r: Vector) -> Vector:
            w = solve_triangular(L, r[E], lower=True, check_finite=False)
            dx = np.zeros(r.size)
            dx[rest[free_bounded]] = _solve(factor, r[rest[free_bounded]] - w @ W_F)
            w -= W_F @ dx[rest[free_bounded]]
            dx[E] = solve_triangular(L, w, lower=True, trans="T", check_finite=False)
            return dx

        return solve

    return face


def _factor(F: Vector) -> Any:
    return cho_factor(F, lower=True, overwrite_a=True, check_finite=False)


def _solve(factor: Any, r: Vector) -> Vector:
    return np.asarray(cho_solve(factor, r, check_finite=False))


def _spread(free: Mask, values: Vector) -> Vector:
    dx = np.zeros(free.size)
    dx[free] = values
    return dx
