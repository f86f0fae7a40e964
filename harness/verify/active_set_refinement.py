"""Solution with prescribed closed rows in extended precision, and active-set exchange.

Let A be a set of closed rows, which hold with equality, and N the set of the other
rows. The displacement u and the multipliers λ_A solve the linear equations

    K u + B_Aᵀλ_A = f − B_Nᵀλ_N,   B_A u = c_A,

with prescribed multipliers λ_N. The solution is refined with residuals in extended
precision. The multiplier of a row that is not closed is on the boundary of the set Λ of
admissible multipliers: an open contact has λ = 0, and a slipping node with the friction
bound g has ‖λ‖ = g. As in a primal-dual active set method, a closed row leaves A if its
multiplier is not in Λ. A row of N enters A if its motion contradicts its multiplier
(for contact, if the gap is negative). The exchange ends when A does not change or
recurs, or at the latest after a given number of exchanges.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.mechanics import Exact, Extended, Mechanics, Real
from mortarbench.harness.sets.blocks import norms
from mortarbench.harness.verify.admissible import closing

MAX_EXCHANGES = 60  #: largest number of exchanges of active sets
#: Number of refinement steps, each with a residual in extended precision.
REFINEMENTS = 6

States = NDArray[np.int8]  #: (m,) state of each row
#: States of a row: multiplier at its lower bound, row closed (multiplier free), or
#: multiplier at its upper bound. For a friction vector of several rows, UPPER denotes
#: any point of the circle ‖λ‖ = g.
LOWER, CLOSED, UPPER = -1, 0, 1

_EPS = Real(np.finfo(Real).eps)


class ActiveSet(NamedTuple):
    """States of the rows, and the multipliers of rows that are not closed."""

    states: States  #: (m,) state of each row
    limits: Extended  #: (m,) multipliers on the boundary of Λ; unused for closed rows

    @property
    def closed(self) -> NDArray[np.bool_]:
        """Mask (m,) of the closed rows."""
        return np.asarray(self.states == CLOSED)

    def at_bounds(self, multipliers: Extended) -> Extended:
        """For rows that are not closed, replace the multipliers (m,) by the limits."""
        return np.where(self.closed, multipliers, self.limits)


def equilibrium(mechanics: Mechanics, force: Extended) -> tuple[Extended, float]:
    """Solve K u = force with u = 0 on fixed components; return u and its error.

    u (n,) is in extended precision and has no rigid motion. The part of `force` along
    rigid motions is disregarded. The returned error is √(rᵀK⁺r) with the residual r,
    that is, the error in the energy norm.
    """
    K, fixed = mechanics.stiffness, mechanics.exact.fixed
    u = np.zeros(force.size, dtype=Real)
    for _ in range(3):
        r = force - K @ u
        r[fixed] = 0
        r = mechanics.motions.without(r)
        step = mechanics.apply_inverse(r)
        left = float(np.sqrt(abs(r @ step)))
        u = u + step
    return u - step, left  # the last residual was computed for this u


def unconstrained_guess(mechanics: Mechanics) -> ActiveSet:
    """Guess the states from the displacement without contact; violated rows are closed.

    If only contact supports a body, all rows are assumed to be closed. Friction rows
    are assumed to stick.
    """
    exact = mechanics.exact
    none = np.zeros(exact.c.size, dtype=Real)
    if mechanics.inverse.kernel.shape[1]:
        return ActiveSet(np.full(exact.c.size, CLOSED, dtype=np.int8), none)
    open_ = exact.motion(equilibrium(mechanics, exact.f)[0]) <= 0
    states = np.where(open_ & exact.contact, LOWER, CLOSED).astype(np.int8)
    return ActiveSet(states, none)


def suggested(exact: Exact, u: Extended, multipliers: Extended) -> ActiveSet:
    """Guess the states from a pair (u, λ): rows with λ + v/D inside Λ are closed.

    Here, v = Bu − c, and D is the compliance of the row. A primal-dual active set
    method uses this rule to determine the next active set. For rows that are not
    closed, `limits` of the result is the projection of λ + v/D onto Λ.
    """
    discs, softness, v = exact.forces.discs, exact.compliance, exact.motion(u)
    states = np.where(multipliers * softness <= -v, LOWER, CLOSED)
    limits = np.zeros_like(multipliers)
    soft = softness[discs.index].mean(axis=1, keepdims=True)
    push = multipliers[discs.index] * soft + v[discs.index]
    size = norms(push)[:, None]
    slips = size >= discs.radius[:, None] * soft
    # if λD + v is zero, λ itself is the limit
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
    """Exchange rows, starting from a guess; return u (n,), λ (m,) and the active set.

    The direction of slipping friction vectors is fixed. The iteration ends if no row
    violates a condition, if an active set recurs, or after `rounds` exchanges. In the
    last case, u belongs to the last active set but one. The last active set need not be
    optimal, so a certificate has to bound the error of u and λ.
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
    """Return the next active set, or None if no row violates a condition."""
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
    """Solve for u (n,) and λ (m,) with equality on the closed rows."""
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
