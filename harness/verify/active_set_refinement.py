"""Solution for given closed rows in extended precision, and exchange of closed rows.

For a set A of closed rows, displacement and multipliers solve linear equations,

    K u + B_Aᵀλ_A = f − B_Nᵀλ_N,   B_A u = c_A,   λ_N prescribed elsewhere,

and are refined with residuals in extended precision. A row that is not closed has its
multiplier on the boundary of Λ: an open contact has λ = 0, and slip has ‖λ‖ = g. As in
a primal-dual active set method, rows are exchanged whose multiplier leaves Λ, or whose
motion contradicts its multiplier (a negative gap), until no such row is left.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.mechanics import (
    AdmissibleForces,
    Exact,
    Extended,
    Mechanics,
    Real,
)
from mortarbench.harness.sets.blocks import norms
from mortarbench.harness.verify.admissible import closing

MAX_EXCHANGES = 60  #: largest number of exchanges of active sets
#: refinements of a solution, each with a residual in extended precision
REFINEMENTS = 6

States = NDArray[np.int8]  #: (m,) state of each row
#: States: multiplier at its lower bound, row closed (multiplier free), multiplier at
#: its upper bound. A friction vector of several rows is UPPER anywhere on its circle.
LOWER, CLOSED, UPPER = -1, 0, 1

_EPS = Real(np.finfo(Real).eps)


class ActiveSet(NamedTuple):
    """States of the rows, and the multipliers of rows that are not closed."""

    states: States
    limits: Extended  #: (m,) on the boundary of Λ for rows that are not closed

    @property
    def closed(self) -> NDArray[np.bool_]:
        """Mask (m,) of the closed rows."""
        return np.asarray(self.states == CLOSED)

    def at_bounds(self, multipliers: Extended) -> Extended:
        """Replace the multipliers (m,) of rows that are not closed by their limits."""
        return np.where(self.closed, multipliers, self.limits)


def equilibrium(mechanics: Mechanics, force: Extended) -> tuple[Extended, float]:
    """Solve K u = force with u = 0 on fixed components.

    Returns u (n,) in extended precision, without rigid motion, and the energy norm
    √(rᵀK⁺r) of its error, where r is the residual.
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
    return u - step, left  # the u for which the last residual was computed


def unconstrained_guess(mechanics: Mechanics) -> ActiveSet:
    """Guess the states from the displacement without contact: violated rows are closed.

    If only contact supports a body, all rows are assumed closed. Friction rows are
    assumed to stick.
    """
    exact = mechanics.exact
    none = np.zeros(exact.c.size, dtype=Real)
    if mechanics.inverse.kernel.shape[1]:
        return ActiveSet(np.full(exact.c.size, CLOSED, dtype=np.int8), none)
    open_ = exact.motion(equilibrium(mechanics, exact.f)[0]) <= 0
    states = np.where(open_ & exact.contact, LOWER, CLOSED).astype(np.int8)
    return ActiveSet(states, none)


def suggested(exact: Exact, u: Extended, multipliers: Extended) -> ActiveSet:
    """Guess the states from a pair: rows with λ + v/D inside Λ are closed.

    v = Bu − c, and D is the compliance of the row. A primal-dual active set method
    predicts its next active set by the same rule.
    """
    return predicted(exact.forces, multipliers, exact.compliance, exact.motion(u))


def predicted(
    forces: AdmissibleForces, multipliers: Any, softness: Any, v: Any
) -> ActiveSet:
    """Return the states (m,): closed if λ + v/D is inside Λ; its projection otherwise.

    softness : (m,) compliances D ≥ 0 of the rows
    """
    discs = forces.discs
    states = np.where(multipliers * softness <= -v, LOWER, CLOSED)
    limits = np.zeros_like(multipliers)
    soft = softness[discs.index].mean(axis=1, keepdims=True)
    push = multipliers[discs.index] * soft + v[discs.index]
    size = norms(push)[:, None]
    slips = size >= discs.radius[:, None] * soft
    # if λ + v/D gives no direction, that of λ is used
    limits[discs.index] = np.where(
        size > 0,
        push / np.where(size > 0, size, 1) * discs.radius[:, None],
        multipliers[discs.index],
    )
    states[discs.index] = np.where(slips, _sides(limits[discs.index]), CLOSED)
    return ActiveSet(states.astype(np.int8), limits)


def _sides(limits: Extended) -> States:
    """Return the states of friction vectors (k, d) that are not closed."""
    if limits.shape[1] > 1:
        return np.full(limits.shape, UPPER, dtype=np.int8)
    return np.where(limits < 0, LOWER, UPPER).astype(np.int8)


def exchanged(
    mechanics: Mechanics, active: ActiveSet, rounds: int = MAX_EXCHANGES
) -> tuple[Extended, Extended, ActiveSet]:
    """Exchange rows, starting from a guess; return u (n,), multipliers (m,), the set.

    Friction vectors that slip keep their direction. If a set recurs, or after `rounds`
    exchanges, the last set is returned. It need not be optimal; a certificate has to
    bound its error.
    """
    exact, visited = mechanics.exact, set[bytes]()
    for _ in range(rounds):
        u, lam = _solved(mechanics, active)
        following = _next(exact, active, u, lam)
        if following is None or active.states.tobytes() in visited:
            break
        visited.add(active.states.tobytes())
        active = following
    return u, active.at_bounds(exact.forces.project(lam)), active


def _next(
    exact: Exact, active: ActiveSet, u: Extended, lam: Extended
) -> ActiveSet | None:
    """Exchange the rows that violate a condition; return None if no row does."""
    v, discs = exact.motion(u), exact.forces.discs
    rounding = 1e4 * _EPS * (abs(exact.B) @ np.abs(u) + np.abs(exact.c))
    force = 1e4 * _EPS * np.abs(lam).max(initial=Real(0))
    states, limits = active.states.copy(), active.limits.copy()
    opens = exact.contact & active.closed & (lam < -force)
    closes = exact.contact & ~active.closed & (v > rounding)
    sticking = active.closed[discs.index].all(axis=1)
    along = (active.limits * v)[discs.index].sum(axis=1)
    reach = discs.radius * norms(rounding[discs.index])
    slips = sticking & (norms(lam[discs.index]) > discs.radius + force)
    sticks = ~sticking & (along < -reach)
    if not (opens.any() or closes.any() or slips.any() or sticks.any()):
        return None
    states[opens], states[closes], limits[opens] = LOWER, CLOSED, 0
    at = discs.index[slips]
    limits[at] = exact.forces.project(lam)[at]
    states[at], states[discs.index[sticks]] = _sides(limits[at]), CLOSED
    return ActiveSet(states, limits)


def _solved(mechanics: Mechanics, active: ActiveSet) -> tuple[Extended, Extended]:
    """Solve with equality on the closed rows; return u (n,) and multipliers (m,)."""
    exact, motions, closed = mechanics.exact, mechanics.motions, active.closed
    R = motions.constrained
    close = closing(mechanics, closed)
    lam = active.at_bounds(np.zeros(exact.c.size, dtype=Real))
    alpha = np.zeros(R.shape[1], dtype=Real)
    for _ in range(REFINEMENTS):
        force = exact.f - exact.B.T @ lam
        elastic = equilibrium(mechanics, force - motions.KR @ alpha)[0]
        u = elastic + R @ alpha
        excess = (exact.B @ u - exact.c)[closed]
        force = R.T @ force - motions.KR.T @ u
        mu, further = close(excess.astype(np.float64), force.astype(np.float64))
        lam[closed] += mu
        alpha = alpha + further
    return u, lam
