"""Solution for given closed rows in extended precision, and the exchange of rows.

For a set A of closed rows, displacement and multipliers solve linear equations,

    K u + B_Aᵀλ_A = f − B_Nᵀλ_N,   B_A u = c_A,   λ_N at a bound elsewhere,

refined with residuals in extended precision. A row is closed, or its multiplier is at
the lower or the upper bound: an open contact is at the lower one, zero; friction
sticks, or slips at −g or g. As in a primal-dual active set method, rows are exchanged
whose multiplier exceeds a bound, or whose motion contradicts the bound of the
multiplier (a negative gap), until there are none.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.mechanics import Exact, Extended, Mechanics, Real
from mortarbench.harness.verify.admissible import closing

MAX_EXCHANGES = 60  #: largest number of exchanges of active sets
#: refinements of a solution, each with a residual in extended precision
REFINEMENTS = 6

States = NDArray[np.int8]  #: (m,) state of each row
LOWER, CLOSED, UPPER = -1, 0, 1  #: multiplier at its lower bound, free, at its upper

_EPS = Real(np.finfo(Real).eps)


def equilibrium(mechanics: Mechanics, force: Extended) -> tuple[Extended, float]:
    """Solve  K u = force  with u = 0 on fixed components.

    Returns u in extended precision, without rigid motion, and the energy norm of its
    error, √(rᵀK⁺r) with the residual r.
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
    return u - step, left  # the u that the last residual belongs to


def unconstrained_guess(mechanics: Mechanics) -> States:
    """Guess the states from the displacement without contact: violated rows close.

    If only contact supports a body, all rows are guessed to be closed. Friction rows
    are guessed to stick.
    """
    exact = mechanics.exact
    if mechanics.inverse.kernel.shape[1]:
        return np.full(exact.c.size, CLOSED, dtype=np.int8)
    open_ = exact.motion(equilibrium(mechanics, exact.f)[0]) <= 0
    return np.where(open_ & exact.contact, LOWER, CLOSED).astype(np.int8)


def suggested(exact: Exact, u: Extended, multipliers: Extended) -> States:
    """Guess states from a pair: closed where λ + v/D is within its bounds, v = Bu − c.

    D is the compliance of the row; this is the prediction of a primal-dual active set
    method.
    """
    room = multipliers - exact.lower, exact.upper - multipliers
    return predicted(room, exact.compliance, exact.motion(u))


def predicted(room: tuple[Any, Any], softness: Any, v: Any) -> States:
    """Return the states (m,) for λ + v/D: closed within bounds of λ, else at a bound.

    room : (m,) distances of λ from its lower and its upper bound, inf without a bound
    """

    def passed(room: Any, push: Any) -> Any:
        bounded = np.isfinite(room)
        return bounded & (np.where(bounded, room, 0) * softness <= push)

    below, above = passed(room[0], -v), passed(room[1], v)
    return np.where(below, LOWER, np.where(above, UPPER, CLOSED)).astype(np.int8)


def at_bounds(exact: Exact, states: States, multipliers: Extended) -> Extended:
    """Set the multipliers of rows that are not closed to their bounds."""
    upper = np.where(states == UPPER, exact.upper, multipliers)
    return np.asarray(np.where(states == LOWER, exact.lower, upper))


def exchanged(
    mechanics: Mechanics, states: States, rounds: int = MAX_EXCHANGES
) -> tuple[Extended, Extended, States]:
    """Exchange rows, starting from a guess; return u (n,), multipliers (m,), states.

    If a set recurs, or after `rounds` sets, the last one is returned. It need not be
    optimal: a certificate decides.
    """
    exact, visited = mechanics.exact, set[bytes]()
    for _ in range(rounds):
        u, lam = _solved(mechanics, states)
        v = exact.motion(u)
        rounding = 1e4 * _EPS * (abs(exact.B) @ np.abs(u) + np.abs(exact.c))
        force = 1e4 * _EPS * np.abs(lam).max(initial=Real(0))
        closed = states == CLOSED
        below = closed & (lam < exact.lower - force)
        above = closed & (lam > exact.upper + force)
        closes = ((states == LOWER) & (v > rounding)) | (
            (states == UPPER) & (v < -rounding)
        )
        if not (below | above | closes).any() or states.tobytes() in visited:
            break
        visited.add(states.tobytes())
        states = np.where(below, LOWER, np.where(above, UPPER, states))
        states = np.where(closes, CLOSED, states).astype(np.int8)
    within = np.clip(lam, exact.lower, exact.upper)
    return u, at_bounds(exact, states, within), states


def _solved(mechanics: Mechanics, states: States) -> tuple[Extended, Extended]:
    """Solve with equality on the closed rows: u (n,) and multipliers (m,)."""
    exact, motions = mechanics.exact, mechanics.motions
    R, active = motions.felt, states == CLOSED
    close = closing(mechanics, active)
    lam = at_bounds(exact, states, np.zeros(exact.c.size, dtype=Real))
    alpha = np.zeros(R.shape[1], dtype=Real)
    for _ in range(REFINEMENTS):
        force = exact.f - exact.B.T @ lam
        elastic = equilibrium(mechanics, force - motions.KR @ alpha)[0]
        u = elastic + R @ alpha
        excess = (exact.B @ u - exact.c)[active]
        force = R.T @ force - motions.KR.T @ u
        mu, further = close(excess.astype(np.float64), force.astype(np.float64))
        lam[active] += mu
        alpha = alpha + further
    return u, lam
