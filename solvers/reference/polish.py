"""Refinement of a solution in extended precision, with active constraints as equations.

For a fixed active set, the KKT conditions are linear. These equations are solved by
iterative refinement (Higham 2002, Accuracy and Stability of Numerical Algorithms, ch.
12), with residuals evaluated in `numpy.longdouble` and a factorisation of

    [P_FF + δ  B_Fᵀ]     F: variables not at a bound,
    [B_F       −δ  ]     B: A and the active rows of G.

The shift δ makes the matrix nonsingular for every positive semidefinite P and every B.
The refinement steps are steps of the proximal method of multipliers (Rockafellar 1976,
Math. Oper. Res. 1), so their limit does not depend on δ. If the solution or its
multipliers are not unique, the steps converge to a solution near the starting point.

After convergence, violated constraints enter the active set, and constraints with a
multiplier of the wrong sign leave it (Hintermüller, Ito and Kunisch 2003, SIAM J.
Optim. 13). The refinement and this update are repeated until the active set no longer
changes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import vstack

from mortarbench.harness import QP, Matrix, Solution, Status
from mortarbench.solvers.reference.saddle import saddle

Extended = NDArray[np.longdouble]
DELTA = 1e-10  #: δ, chosen for a QP whose largest entries are about one
MAX_REFINEMENTS = 40  #: largest number of refinement steps per active set
#: the refinement ends if a step is not shorter than this factor times the previous step
MAX_STEP_RATIO = 0.9
MAX_ACTIVE_SETS = 30
#: number of updates of the whole active set; in later updates, only the constraint with
#: the largest error changes
FULL_CHANGES = 10
#: multipliers of the wrong sign and violations of constraints, relative to the largest
#: component, count as rounding errors below this value
SIGN_ROUNDING = 4 * float(np.finfo(float).eps)


class _Active(NamedTuple):
    side: NDArray[np.int8]  #: (n,) −1 at lb, 1 at ub, 0 between
    rows: NDArray[np.bool_]  #: (p,) active rows of G


class _Point(NamedTuple):
    x: Extended
    y: Extended
    z: Extended


@dataclass(frozen=True, eq=False)
class _Problem:
    """A QP with its matrices in extended precision."""

    qp: QP
    P: Matrix
    A: Matrix
    G: Matrix

    def gradient(self, at: _Point) -> Extended:
        """Return the gradient Px + q + Aᵀy + Gᵀz in extended precision."""
        g = self.P @ at.x + self.qp.q + self.A.T @ at.y + self.G.T @ at.z
        return np.asarray(g, dtype=np.longdouble)


@np.errstate(all="ignore")  # the caller rejects points whose residuals overflow
def polish(qp: QP, start: Solution, delta: float = DELTA) -> Iterator[Solution]:
    """Yield a refined point for each tested active set; often one active set suffices.

    qp : QP whose largest entries are about one, with P, A and G all dense or all sparse
    start : point near a solution, for example the result of an interior-point method
    delta : δ; with a smaller value, weaker curvature and more nearly parallel rows can
        be resolved, but the matrix is closer to singularity
    """
    problem = _Problem(qp, *(M.astype(np.longdouble) for M in (qp.P, qp.A, qp.G)))
    at = _Point(*(v.astype(np.longdouble) for v in (start.x, start.y, start.z)))
    slack = qp.h - qp.G @ start.x
    side = 1 * (start.z_box > qp.ub - start.x) - 1 * (-start.z_box > start.x - qp.lb)
    side = np.where(qp.lb == qp.ub, -1, side).astype(np.int8)
    active = _Active(side, start.z > slack)
    for k in range(MAX_ACTIVE_SETS):
        try:
            at = _solve_active_set(problem, active, at, delta)
        except ArithmeticError:
            return
        yield replace(_round(problem, active, at), iterations=start.iterations)
        new = _update_active_set(problem, active, at, one=k >= FULL_CHANGES)
        if not any((a != b).any() for a, b in zip(new, active, strict=True)):
            return
        active = new


def _solve_active_set(
    problem: _Problem, active: _Active, at: _Point, delta: float
) -> _Point:
    """Solve the KKT equations of an active set by iterative refinement."""
    qp, m = problem.qp, problem.qp.b.size
    free, rows = np.flatnonzero(active.side == 0), np.flatnonzero(active.rows)
    x = np.where(active.side < 0, qp.lb, np.where(active.side > 0, qp.ub, at.x))
    y, z = at.y.copy(), np.where(active.rows, at.z, 0)
    P, A, G = qp.P[free][:, free], qp.A[:, free], qp.G[rows][:, free]
    B = np.vstack([A, G]) if isinstance(P, np.ndarray) else vstack([A, G])
    solve = saddle(P, B)(np.full(free.size, delta), np.full(B.shape[0], delta))
    size = np.inf
    for _ in range(MAX_REFINEMENTS):
        r = problem.gradient(_Point(x, y, z))[free]
        t = np.append(problem.A @ x - qp.b, (problem.G @ x - qp.h)[rows])
        dx, rest = solve(-r.astype(float), -t.astype(float))
        last, size = size, _sup(dx, rest)
        if not size < MAX_STEP_RATIO * last:
            break
        x[free] += dx
        y += rest[:m]
        z[rows] += rest[m:]
    return _Point(x, y, z)


def _update_active_set(
    problem: _Problem, active: _Active, at: _Point, *, one: bool
) -> _Active:
    """Update the active set according to violated constraints and multiplier signs.

    Nearly dependent active rows may require huge multipliers to be satisfied at the
    same time. Therefore, if no other constraint is wrong, active rows with a remaining
    slack are released.

    one : if True, change only the constraint with the largest error; violations are
        measured relative to the size of x, and signs relative to the size of the
        gradient
    """
    qp, side = problem.qp, active.side
    g = problem.gradient(at)
    X, S = _sup(at.x) or 1.0, _sup(g, qp.q, at.z) or 1.0
    outside = np.maximum(qp.lb - at.x, at.x - qp.ub) / X
    pulled = np.where(qp.lb == qp.ub, 0.0, side * g) / S
    wrong_side = np.where(side == 0, outside, pulled)
    violated = (problem.G @ at.x - qp.h) / X
    wrong_rows = np.where(active.rows, -at.z / S, violated)
    if max(wrong_side.max(initial=0), wrong_rows.max(initial=0)) < SIGN_ROUNDING:
        wrong_rows = np.where(active.rows, -violated, 0.0)
    least = SIGN_ROUNDING
    if one:
        least = max(
            SIGN_ROUNDING, _sup(*(np.maximum(w, 0) for w in (wrong_side, wrong_rows)))
        )
    change_side, change_rows = wrong_side >= least, wrong_rows >= least
    entering = np.where(at.x < qp.lb, -1, 1)
    new = np.where(change_side, np.where(side == 0, entering, 0), side)
    return _Active(new.astype(np.int8), active.rows ^ change_rows)


def _round(problem: _Problem, active: _Active, at: _Point) -> Solution:
    """Round to double precision; z_box follows from stationarity at the rounded x."""
    qp, side = problem.qp, active.side
    x = np.clip(at.x.astype(float), qp.lb, qp.ub)
    y, z = at.y.astype(float), np.maximum(at.z.astype(float), 0)
    rounded = _Point(*(v.astype(np.longdouble) for v in (x, y, z)))
    force = -problem.gradient(rounded).astype(float)
    z_box = np.where(side < 0, np.minimum(force, 0), 0.0)
    z_box = np.where(side > 0, np.maximum(force, 0), z_box)
    z_box = np.where(qp.lb == qp.ub, force, z_box)
    return Solution(status=Status.SOLVED, x=x, y=y, z=z, z_box=z_box)


def _sup(*vectors: NDArray[Any]) -> float:
    return float(max(np.abs(v).max(initial=0.0) for v in vectors))
