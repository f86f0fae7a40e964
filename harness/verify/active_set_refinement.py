"""Displacement and contact forces for given closed rows, and the exchange of rows.

Given the rows A that are closed, both follow from linear equations,

    K u + B_Aᵀλ_A = f − B_Nᵀλ_N,   B_A u = c_A,   λ_N at a bound elsewhere,

refined with residuals in extended precision until nothing is left of them. A row is
closed, or at the lower or the upper bound of its multiplier: an open contact is at the
lower one, zero; friction sticks, or slips at −g or g. Rows whose multiplier exceeds a
bound, or whose motion is against the bound that they are at (a gap that is negative),
are exchanged, as in a primal-dual active set method, until there is none.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.mechanics import Exact, Extended, Mechanics, Real
from mortarbench.harness.verify.admissible import closing

EXCHANGES = 60  #: of active sets
REFINEMENTS = 6

States = NDArray[np.int8]  #: (m,) of each row
LOWER, CLOSED, UPPER = -1, 0, 1  #: where the multiplier is, or that the row is closed

_EPS = Real(np.finfo(Real).eps)


def equilibrium(mechanics: Mechanics, force: Extended) -> tuple[Extended, float]:
    """Solve  K u = force  on the free components, zero on the others.

    Returns u, without rigid motion, and the energy norm of what one refinement left
    undone, √(rᵀK⁺r) with the residual r, in extended precision.
    """
    K, fixed = mechanics.stiffness, mechanics.exact.fixed
    u = np.zeros(force.size, dtype=Real)
    for _ in range(3):
        r = force - K @ u
        r[fixed] = 0
        r = mechanics.without_rigid_motion(r)
        step = mechanics.apply_inverse(r)
        left = float(np.sqrt(abs(r @ step)))
        u = u + step
    return u - step, left


def unconstrained_guess(mechanics: Mechanics) -> States:
    """Guess the rows that bodies alone would violate; all, where contact holds them.

    Friction is guessed to stick.
    """
    exact = mechanics.exact
    if mechanics.inverse.kernel.shape[1]:
        return np.full(exact.c.size, CLOSED, dtype=np.int8)
    open_ = exact.motion(equilibrium(mechanics, exact.f)[0]) <= 0
    return np.where(open_ & exact.contact, LOWER, CLOSED).astype(np.int8)


def suggested(exact: Exact, u: Extended, multipliers: Extended) -> States:
    """Guess from a pair which rows are closed: λ + v/D within its bounds, v = Bu − c.

    D is the compliance of the row; the guess is that of a primal-dual active set
    method.
    """
    room = multipliers - exact.lower, exact.upper - multipliers
    return predicted(room, exact.compliance, exact.motion(u))


def predicted(room: tuple[Any, Any], softness: Any, v: Any) -> States:
    """Tell where λ + v/D is: within its bounds, or beyond which of them.

    room : of λ to its lower and its upper bound (m,), infinite where there is none
    """

    def passed(room: Any, push: Any) -> Any:
        bounded = np.isfinite(room)
        return bounded & (np.where(bounded, room, 0) * softness <= push)

    below, above = passed(room[0], -v), passed(room[1], v)
    return np.where(below, LOWER, np.where(above, UPPER, CLOSED)).astype(np.int8)


def at_bounds(exact: Exact, states: States, multipliers: Extended) -> Extended:
    """Set the multipliers of the rows that are not closed to the bounds they are at."""
    upper = np.where(states == UPPER, exact.upper, multipliers)
    return np.asarray(np.where(states == LOWER, exact.lower, upper))


def exchanged(
    mechanics: Mechanics, states: States, rounds: int = EXCHANGES
) -> tuple[Extended, Extended, States]:
    """Exchange rows from a guess on; return u (n,), multipliers (m,), and states.

    Where sets recur, or there are too many, the last one is returned: whether it is
    right is for a certificate to say.
    """
    exact, seen = mechanics.exact, set[bytes]()
    for _ in range(rounds):
        u, lam = _given(mechanics, states)
        v = exact.motion(u)
        rounding = 1e4 * _EPS * (abs(exact.B) @ np.abs(u) + np.abs(exact.c))
        force = 1e4 * _EPS * np.abs(lam).max(initial=Real(0))
        closed = states == CLOSED
        below = closed & (lam < exact.lower - force)
        above = closed & (lam > exact.upper + force)
        closes = ((states == LOWER) & (v > rounding)) | (
            (states == UPPER) & (v < -rounding)
        )
        if not (below | above | closes).any() or states.tobytes() in seen:
            break
        seen.add(states.tobytes())
        states = np.where(below, LOWER, np.where(above, UPPER, states))
        states = np.where(closes, CLOSED, states).astype(np.int8)
    within = np.clip(lam, exact.lower, exact.upper)
    return u, at_bounds(exact, states, within), states


def _given(mechanics: Mechanics, states: States) -> tuple[Extended, Extended]:
    """Solve with equality on the closed rows: u (n,) and multipliers (m,)."""
    exact, motions = mechanics.exact, mechanics.motions
    R, active = motions.felt, states == CLOSED
    close = closing(mechanics, active)
    lam = at_bounds(exact, states, np.zeros(exact.c.size, dtype=Real))
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
