"""Admissible pairs near an answer: a displacement without penetration, and balance.

Moving slave nodes alone would not do for the displacement: the end nodes of an arc may
be held, and a mortar row couples several.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csc_array, csc_matrix, csr_array, eye_array
from scipy.sparse.linalg import LinearOperator, cg, splu

from harness.mechanics import Extended, Mechanics, Real
from harness.qp import Vector

ROUNDS = 20  #: of growing the set of rows
DENSE = 2000  #: rows up to which F_VV is formed
_EPS = Real(np.finfo(Real).eps)


def admissible(
    mechanics: Mechanics, u: Extended, closed: NDArray[np.bool_]
) -> Extended | None:
    """Find û with Bû ≤ c near u, with equality on the rows `closed`; None if none.

    û = u − K⁺B_Vᵀμ + Rα,  F_VV μ = (Bu − c)_V + B_V Rα  is nearest in the energy norm
    with equality on the rows V; these are the closed ones, the violated ones, and those
    that get violated meanwhile. It aims inside by some units of the last place. Where
    that does not end, θu with θ < 1 is admissible while c > 0.
    """
    B, c = mechanics.exact.B, mechanics.exact.c
    size = np.abs(u).max(initial=Real(0))  # of what is added up to get there
    reach = abs(B) @ (16 * np.abs(u) + 4 * size)
    inside = _EPS * (reach + 16 * np.abs(c))
    held = np.zeros_like(closed)
    moved, step = u, None
    for _ in range(ROUNDS):
        gap = c - B @ moved
        wanted = held | closed | (gap < 0)
        if not wanted.any():
            return u
        if (wanted != held).any():
            held = wanted
            step = _nearest(mechanics, held)
        elif (gap >= 0).all() and (gap[held] <= 4 * inside[held]).all():
            return moved
        assert step is not None
        moved = moved + step((inside - gap)[held].astype(np.float64))
        if not np.isfinite(moved).all():
            return _shrunk(mechanics, u)
    return moved if (c - B @ moved >= 0).all() else _shrunk(mechanics, u)


def _shrunk(mechanics: Mechanics, u: Extended) -> Extended | None:
    """Return θu with the largest θ that is admissible for sure."""
    B, c = mechanics.exact.B, mechanics.exact.c
    if (c < 0).any():
        return None
    reach = B @ u
    beyond = reach > c
    theta = min((c[beyond] / reach[beyond]).min(initial=Real(1)), Real(1))
    for _ in range(8):  # the product may be rounded outwards
        if not (B @ (theta * u) > c).any():
            return np.asarray(theta * u)
        theta = theta * (1 - 8 * _EPS)
    return np.zeros_like(u)


def _nearest(
    mechanics: Mechanics, rows: NDArray[np.bool_]
) -> Callable[[Vector], Vector]:
    """Return the map from excesses t (v,) to the smallest δ with B_V δ = −t."""
    B_V = csr_array(mechanics.primal.G)[np.flatnonzero(rows)]
    inverse, solve = mechanics.inverse, closing(mechanics, rows)

    def step(t: Vector) -> Vector:
        mu, alpha = solve(t, np.zeros(inverse.kernel.shape[1]))
        return np.asarray(inverse.kernel @ alpha - inverse(B_V.T @ mu))

    return step


def closing(
    mechanics: Mechanics, rows: NDArray[np.bool_]
) -> Callable[[Vector, Vector], tuple[Vector, Vector]]:
    """Return the solve for the multipliers that close the rows V, and rigid motions.

    ::

        F_VV μ − B_V R α = t,    RᵀB_Vᵀμ = e,        F_VV = B_V K⁺B_Vᵀ

    for excesses t (v,) and loads e (r,) that are to be balanced.
    """
    B_V = csr_array(mechanics.primal.G)[np.flatnonzero(rows)]
    F = _compliance(mechanics, B_V)
    G = np.asarray(B_V @ mechanics.inverse.kernel)
    FG = np.stack([F(g) for g in G.T], axis=1) if G.size else G
    S = np.linalg.pinv(G.T @ FG)

    def solve(t: Vector, e: Vector) -> tuple[Vector, Vector]:
        Ft = F(t)
        alpha = S @ (e - G.T @ Ft)
        return Ft + FG @ alpha, alpha

    return solve


def _compliance(mechanics: Mechanics, B_V: Any) -> Callable[[Vector], Vector]:
    """Return the solve with F_VV = B_V K⁺B_Vᵀ, or, for very many rows, CG with it.

    F_VV may be singular, or very nearly; what a shift of the last digits leaves, the
    next round mends. CG is preconditioned by B_V K B_Vᵀ (lumped, as FETI's).
    """
    v, inverse = B_V.shape[0], mechanics.inverse
    if v <= DENSE:
        F = inverse.congruence(B_V)
        F[np.diag_indices(v)] += 1e-13 * F.diagonal().max() + np.finfo(float).tiny
        factor = cho_factor(F, lower=True)
        return lambda t: np.asarray(cho_solve(factor, t))
    F = LinearOperator((v, v), lambda mu: B_V @ inverse(B_V.T @ mu.ravel()))
    stiffness = csc_array(B_V @ mechanics.primal.P @ B_V.T)
    shift = 1e-10 * stiffness.diagonal().max()
    lumped = splu(csc_matrix(stiffness + shift * eye_array(v)))
    M = LinearOperator((v, v), lambda t: lumped.solve(t.ravel()))
    return lambda t: np.asarray(cg(F, t, rtol=1e-8, maxiter=300, M=M)[0])


def balanced(mechanics: Mechanics, multipliers: Extended) -> Extended | None:
    """Find λ̂ ≥ 0 near `multipliers` ≥ 0 with RᵀBᵀλ̂ = Rᵀf; None if there is none.

    Nearest relative to their sizes, min ½Σ(λ̂ᵢ − λᵢ)²/wᵢ with wᵢ ≈ λᵢ: what balances the
    load must not act across wide gaps, where it would do work. λ̂ = (λ + WGν)₊ with
    G = BR, where ν minimises a convex function of as many variables as there are rigid
    motions: semismooth Newton with halved steps.
    """
    R = mechanics.inverse.kernel
    if not R.shape[1]:
        return multipliers
    G = mechanics.exact.B @ R.astype(Real)
    load = R.T.astype(Real) @ mechanics.exact.f
    largest = multipliers.max(initial=Real(0))
    w = multipliers / largest if largest > 0 else np.ones_like(multipliers)
    on = w > 0
    if (found := _balanced(multipliers[on], w[on], G[on], load)) is not None:
        multipliers = multipliers.copy()
        multipliers[on] = found
        return multipliers
    return _balanced(multipliers, w + 1e-6, G, load)  # others have to help


def _balanced(
    multipliers: Extended, w: Extended, G: Extended, load: Extended
) -> Extended | None:
    """Minimise for positive weights; None where no λ̂ ≥ 0 balances the load."""

    def shifted(nu: Extended) -> tuple[Extended, Any]:
        lam = np.maximum(multipliers + w * (G @ nu), 0)
        return lam, 0.5 * (lam @ (lam / w)) - load @ nu

    nu = np.zeros(load.size, dtype=Real)
    lam, value = shifted(nu)
    everything = G.T @ (w[:, None] * G)
    for _ in range(100):
        missing = load - G.T @ lam
        if (np.abs(missing) <= 64 * _EPS * (np.abs(load) + np.abs(G).T @ lam)).all():
            return np.asarray(lam)
        on = lam > 0
        hessian = G[on].T @ (w[on, None] * G[on]) + 1e-8 * everything
        step = np.linalg.pinv(hessian.astype(np.float64)) @ missing.astype(np.float64)
        for _ in range(60):
            lam, trial = shifted(nu + step)
            if trial <= value - 1e-4 * (missing @ step) + 4 * _EPS * abs(value):
                break
            step = step / 2
        nu, value = nu + step, trial
    return None
