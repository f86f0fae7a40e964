"""Displacement and contact forces for given closed rows, and the exchange of rows.

Given the rows A that are closed, both follow from linear equations,

    K u + B_Aᵀλ_A = f,   B_A u = c_A,   λ = 0 elsewhere,

refined with residuals in extended precision until nothing is left of them. Rows whose
multiplier pulls or whose gap is negative are exchanged, as in a primal-dual active set
method, until there is none.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from harness.mechanics import Extended, Mechanics, Real
from harness.verify.admissible import closing

EXCHANGES = 60  #: of active sets
REFINEMENTS = 6

_EPS = Real(np.finfo(Real).eps)


def equilibrium(mechanics: Mechanics, force: Extended) -> tuple[Extended, float]:
    """Solve  K u = force  on the free components, zero on the others.

    Returns u, without rigid motion, and the energy norm of what one refinement left
    undone, √(rᵀK⁺r) with the residual r, in extended precision.
    """
    K, held = mechanics.exact.K, mechanics.exact.held
    u = np.zeros(force.size, dtype=Real)
    for _ in range(3):
        r = force - K @ u
        r[held] = 0
        r = mechanics.still(r)
        step = mechanics.relaxed(r)
        left = float(np.sqrt(abs(r @ step)))
        u = u + step
    return u - step, left


def unconstrained_guess(mechanics: Mechanics) -> NDArray[np.bool_]:
    """Guess the rows that bodies alone would violate; all, where contact holds them."""
    exact = mechanics.exact
    if mechanics.inverse.kernel.shape[1]:
        return np.ones(exact.c.size, dtype=bool)
    return np.asarray(exact.B @ equilibrium(mechanics, exact.f)[0] > exact.c)


def exchanged(
    mechanics: Mechanics, active: NDArray[np.bool_], rounds: int = EXCHANGES
) -> tuple[Extended, Extended, NDArray[np.bool_]]:
    """Exchange rows from a guess on; return u (n,), multipliers (m,) ≥ 0, and rows.

    Where sets recur, or there are too many, the last one is returned: whether it is
    right is for a certificate to say.
    """
    exact, seen = mechanics.exact, set[bytes]()
    for _ in range(rounds):
        u, lam = _given(mechanics, active)
        gap = exact.c - exact.B @ u
        rounding = 1e4 * _EPS * (abs(exact.B) @ np.abs(u) + np.abs(exact.c))
        pulls = active & (lam < -1e4 * _EPS * np.abs(lam).max(initial=Real(0)))
        closes = ~active & (gap < -rounding)
        if not (pulls.any() or closes.any()) or active.tobytes() in seen:
            break
        seen.add(active.tobytes())
        active = (active & ~pulls) | closes
    return u, np.where(active, np.maximum(lam, 0), 0), active


def _given(
    mechanics: Mechanics, active: NDArray[np.bool_]
) -> tuple[Extended, Extended]:
    """Solve with equality on the active rows: u (n,) and multipliers (m,)."""
    exact, motions = mechanics.exact, mechanics.motions
    R = motions.felt
    close = closing(mechanics, active)
    lam = np.zeros(exact.c.size, dtype=Real)
    alpha = np.zeros(R.shape[1], dtype=Real)
    for _ in range(REFINEMENTS):
        force = exact.f - exact.B.T @ lam
        at_rest = equilibrium(mechanics, force - motions.KR @ alpha)[0]
        u = at_rest + R @ alpha
        excess = (exact.B @ u - exact.c)[active]
        force = R.T @ force - motions.KR.T @ u
        mu, further = close(excess.astype(np.float64), force.astype(np.float64))
        lam[active] += mu
        alpha = alpha + further
    return u, lam
