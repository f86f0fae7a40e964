"""Primal-dual interior-point method that computes a starting point for refinement.

The method is Mehrotra's predictor-corrector method for the problem  min ½xᵀPx + qᵀx,
Ax = b,  Cx + s = d,  s ≥ 0,  where C contains the rows of G and of the finite bounds
(Nocedal and Wright 2006, Numerical Optimization, ch. 16.6; Gertz and Wright 2003, ACM
Trans. Math. Softw. 29). With the diagonal matrix S/Z of the entries sᵢ/zᵢ and the
centring parameter σ, a step solves

    [P + δ  Aᵀ   Cᵀ ] [dx]   [−(Px + q + Aᵀy + Cᵀz)  ]
    [A      −δ      ] [dy] = [−(Ax − b)              ],  ds = −(Cx + s − d) − C dx,
    [C          −S/Z] [dz]   [−(Cx + s − d) + Z⁻¹r_sz]

first for r_sz = sz (predictor), then for r_sz = sz + ds dz − σμ (corrector), where
products are componentwise and μ = sᵀz/(number of rows of C). The step length is 1, or
0.995 times the length that leads to the boundary of the set s, z ≥ 0, whichever is
smaller. It is the same for x, y, z and s.

A disc ‖x_I‖ ≤ r is treated as the smooth constraint  ‖x_I‖²/2r + s = r/2.  The row of C
for the disc is x_I/r at the current x, and the multiplier z of the disc adds z/r to the
diagonal of P.

δ is the parameter of a proximal method of multipliers centred at the iterate
(Pougkakiotis and Gondzio 2021, Comput. Optim. Appl. 78). With δ > 0, P may be singular
and rows may be linearly dependent. The solution does not depend on δ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, eye_array, issparse, vstack

from mortarbench.harness import (
    QP,
    Discs,
    Matrix,
    Solution,
    Status,
    Vector,
)
from mortarbench.harness.sets.blocks import norms
from mortarbench.harness.sets.convex import hull
from mortarbench.solvers.common.stopping import relative_residual
from mortarbench.solvers.reference.saddle import Factorise, Solve, saddle

DELTA = 1e-10  #: δ, chosen for a QP whose largest entries are about one
#: KKT residual at which the iteration ends; at this residual the active constraints can
#: be identified, which `polish` then treats as equations
STOP_RESIDUAL = 1e-11
MAX_ITERATIONS = 100
#: the method ends after this number of consecutive iterations, none of which halved the
#: smallest residual so far
PATIENCE = 12
#: largest fraction of the distance to the boundary that a step covers
BOUNDARY_FRACTION = 0.995


class Iterate(NamedTuple):
    """Point with multipliers y, z and slacks s, where s, z > 0."""

    x: Vector
    y: Vector
    z: Vector
    s: Vector


@dataclass(frozen=True, eq=False)
class _Problem:
    """QP in the form  Ax = b,  Cx + s = d.

    A contains rows for fixed variables. C contains the discs, G and the finite bounds.
    """

    qp: QP
    A: Matrix
    b: Vector
    G: csr_array
    d: Vector
    fixed: NDArray[np.int64]
    upper: NDArray[np.int64]
    lower: NDArray[np.int64]
    discs: tuple[Discs, ...]  #: discs of positive radius
    #: maps the rows C₁ of discs and G to a function that factorises [P + D Bᵀ; B −W]
    #: with B = [A; C₁]
    saddle: Callable[[Matrix], Factorise]
    delta: float

    @property
    def rows(self) -> int:
        """Number of discs plus number of rows of G."""
        return int(self.qp.h.size) + sum(len(one.index) for one in self.discs)

    def C(self, x: Vector) -> Vector:
        """Return ‖x_I‖²/2r for the discs, followed by Cx for the other rows."""
        of_discs = [norms(x[one.index]) ** 2 / one.radius / 2 for one in self.discs]
        return np.concatenate([*of_discs, self.G @ x, x[self.upper], -x[self.lower]])

    def at(self, x: Vector, z: Vector) -> tuple[csr_array, Vector]:
        """Return the rows of discs (at x) and G, and the terms of discs in diag P.

        z : multipliers of all rows of C, starting with the discs
        """
        n, first = x.size, 0
        rows, curvature = list[Matrix](), np.zeros(n)
        for one in self.discs:
            k, d = one.index.shape
            values = x[one.index] / one.radius[:, None]
            start = d * np.arange(k + 1)
            rows.append(
                csr_array((values.ravel(), one.index.ravel(), start), shape=(k, n))
            )
            curvature[one.index] = (z[first : first + k] / one.radius)[:, None]
            first += k
        return csr_array(vstack([*rows, self.G])), curvature

    def box_T(self, z: Vector, *, start: Vector, lower: float = -1.0) -> Vector:
        """Add the multipliers z of upper and lower bounds to `start` (n,).

        lower : factor of the multipliers of lower bounds
        """
        start[self.upper] += z[: self.upper.size]
        start[self.lower] += lower * z[self.upper.size :]
        return start

    def factorise(self, w: Vector, rows: Matrix, curvature: Vector) -> Solve:
        """Factorise the matrix of a step with S/Z = diag(w); return the solve function.

        The rows of bounds are eliminated, which adds 1/w to the diagonal of P.

        rows, curvature : results of `at`
        """
        m, p = self.b.size, self.rows
        w_box = w[p:]
        solve = self.saddle(rows)(
            self.box_T(1 / w_box, start=curvature + self.delta, lower=1.0),
            np.append(np.full(m, self.delta), w[:p]),
        )

        def solve_all(r: Vector, t: Vector) -> tuple[Vector, Vector]:
            t_box = t[m + p :]
            r = self.box_T(t_box / w_box, start=r.copy())
            dx, rest = solve(r, t[: m + p])
            box = np.append(dx[self.upper], -dx[self.lower])
            return dx, np.append(rest, (box - t_box) / w_box)

        return solve_all

    def solution(self, at: Iterate) -> Solution:
        """Return the iterate as a solution of the QP, with the multipliers z_box."""
        m, p = self.qp.b.size, self.rows
        _, curvature = self.at(at.x, at.z)
        z_box = curvature * at.x  # multipliers of discs
        z_box[self.fixed] = at.y[m:]
        z_box[self.upper] += at.z[p : p + self.upper.size]
        z_box[self.lower] -= at.z[p + self.upper.size :]
        return Solution(
            status=Status.SOLVED,
            x=at.x,
            y=at.y[:m],
            z=at.z[p - self.qp.h.size : p],
            z_box=z_box,
        )


# an overflow makes the residual infinite or NaN, which ends the loop
@np.errstate(all="ignore")
def interior_point(qp: QP, delta: float = DELTA) -> Solution:
    """Run the interior-point method; return the iterate with the smallest KKT residual.

    At this iterate, the slacks and multipliers of all inequalities are positive. The
    constants are chosen for a QP whose largest entries are about one (`equilibrate`).
    If the QP has no solution, no exception is raised, so the caller must check the
    residual.
    """
    problem = _problem(qp, delta)
    best, least, stalled = Solution.without_point(qp, Status.FAILED), np.inf, 0
    try:
        at = _start(problem)
        for k in range(MAX_ITERATIONS):
            point = replace(problem.solution(at), iterations=k)
            worst = relative_residual(qp, point, STOP_RESIDUAL)
            stalled = 0 if worst < least / 2 else stalled + 1
            if worst < least:
                best, least = point, worst
            if least <= STOP_RESIDUAL or stalled == PATIENCE or not np.isfinite(worst):
                break
            at = _step(problem, at)
    except ArithmeticError:  # a system is singular; return the best iterate
        pass
    return best


def _problem(qp: QP, delta: float) -> _Problem:
    lb, ub = hull(qp.sets, qp.q.size)
    is_fixed = lb == ub
    fixed, upper, lower = (
        np.flatnonzero(mask)
        for mask in (
            is_fixed,
            np.isfinite(qp.ub) & ~is_fixed,
            np.isfinite(qp.lb) & ~is_fixed,
        )
    )
    unit = eye_array(qp.q.size, format="csr")
    A: Matrix = csr_array(vstack([csr_array(qp.A), unit[fixed]]))
    if isinstance(qp.P, np.ndarray):
        A = A.toarray()
    discs = tuple(
        Discs(one.index[one.radius > 0], one.radius[one.radius > 0])
        for one in qp.sets
        if isinstance(one, Discs)
    )
    without_rows = None if discs else saddle(qp.P, _stacked(A, qp.G))
    return _Problem(
        qp=qp,
        A=A,
        b=np.append(qp.b, lb[fixed]),
        G=csr_array(qp.G),
        d=np.concatenate(
            [*(one.radius / 2 for one in discs), qp.h, qp.ub[upper], -qp.lb[lower]]
        ),
        fixed=fixed,
        upper=upper,
        lower=lower,
        discs=discs,
        saddle=lambda rows: without_rows or saddle(qp.P, _stacked(A, rows)),
        delta=delta,
    )


def _stacked(A: Matrix, rows: Matrix) -> Matrix:
    """Stack rows below A; the result is dense if A is dense."""
    if isinstance(A, np.ndarray):
        return np.vstack([A, rows.toarray() if issparse(rows) else rows])
    return vstack([A, rows])


def _start(problem: _Problem) -> Iterate:
    """Return the first iterate: a penalised minimiser, with s and z made positive.

    The term ½‖Cx − d‖² replaces the constraint Cx ≤ d (Vandenberghe 2010, The CVXOPT
    linear and quadratic cone program solvers, section 5.3).
    """
    qp, m = problem.qp, problem.b.size
    solve = problem.factorise(
        np.ones(problem.d.size), *problem.at(0 * qp.q, 0 * problem.d)
    )
    x, rest = solve(-qp.q, np.append(problem.b, problem.d))
    y, z = rest[:m], rest[m:]
    unit = float(np.abs(z).max(initial=0.0)) or 1.0
    s, z = (v + max(0.0, unit - v.min(initial=unit)) for v in (-z, z))
    # without this projection, x may start far outside a disc, and the slack of the disc
    # then becomes small before x reaches the disc
    for one in problem.discs:
        x = one.project(x)
    return Iterate(x, y, z, s)


def _step(problem: _Problem, at: Iterate) -> Iterate:
    """Return the next iterate, computed by a predictor and a centring corrector."""
    qp, A, C, m = problem.qp, problem.A, problem.C, problem.b.size
    x, y, z, s = at
    rows, curvature = problem.at(x, z)
    p = problem.rows
    r_d = qp.P @ x + qp.q + A.T @ y + problem.box_T(z[p:], start=rows.T @ z[:p])
    r_p, r_c = A @ x - problem.b, C(x) + s - problem.d
    solve = problem.factorise(s / z, rows, curvature)

    def direction(r_sz: Vector) -> Iterate:
        dx, rest = solve(-r_d, np.append(-r_p, r_sz / z - r_c))
        C_dx = [rows @ dx, dx[problem.upper], -dx[problem.lower]]
        return Iterate(dx, rest[:m], rest[m:], -r_c - np.concatenate(C_dx))

    step = direction(s * z)
    if z.size:
        mu, length = s @ z / z.size, _step_length(at, step)
        affine = (s + length * step.s) @ (z + length * step.z) / z.size
        # σ = (μ_affine/μ)³, Mehrotra's choice
        step = direction(s * z + step.s * step.z - (affine / mu) ** 3 * mu)
    length = min(1.0, BOUNDARY_FRACTION * _step_length(at, step))
    return Iterate(*(v + length * dv for v, dv in zip(at, step, strict=True)))


def _step_length(at: Iterate, step: Iterate) -> float:
    """Return the largest step length with s, z ≥ 0, at most 1/BOUNDARY_FRACTION."""
    lengths = [-v[dv < 0] / dv[dv < 0] for v, dv in ((at.s, step.s), (at.z, step.z))]
    return float(np.concatenate(lengths).min(initial=1 / BOUNDARY_FRACTION))
