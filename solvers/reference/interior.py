"""A primal-dual interior-point method: where the reference solve looks first.

Mehrotra's predictor and corrector for  min ½xᵀPx + qᵀx,  Ax = b,  Cx + s = d,  s ≥ 0
(Nocedal and Wright 2006, Numerical Optimization, ch. 16.6; Gertz and Wright 2003, ACM
Trans. Math. Softw. 29), with C the rows of G and of the finite bounds. A step solves

    [P + δ  Aᵀ   Cᵀ ] [dx]   [−(Px + q + Aᵀy + Cᵀz)  ]
    [A      −δ      ] [dy] = [−(Ax − b)              ],  ds = −(Cx + s − d) − C dx,
    [C          −S/Z] [dz]   [−(Cx + s − d) + Z⁻¹r_sz]

for r_sz = sz (predictor), then r_sz = sz + ds dz − σμ (corrector), and goes 0.995 of
the way to the next bound, by one length in x, y, z and s. δ is that of a proximal
method of multipliers centred at the iterate (Pougkakiotis and Gondzio 2021, Comput.
Optim. Appl. 78): it moves no solution, and P may be singular and rows dependent.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, eye_array, vstack

from mortarbench.harness import QP, Matrix, Solution, Status, Vector, kkt_residuals
from mortarbench.solvers.reference.saddle import Factorise, Solve, saddle

DELTA = 1e-10  #: of a QP whose largest entries are about one
CLOSE = 1e-11  #: KKT residual that tells the active constraints from the others
MOST = 100  #: iterations
PATIENCE = 12  #: iterations that need not lessen the residual
KEEP = 0.995  #: of the way to the boundary


class Iterate(NamedTuple):
    """A point with s, z > 0."""

    x: Vector
    y: Vector
    z: Vector
    s: Vector


@dataclass(frozen=True, eq=False)
class _Problem:
    """Fixed variables are rows of A here; C holds G, then upper, then lower bounds."""

    qp: QP
    A: Matrix
    b: Vector
    G: csr_array
    G_T: csc_array
    d: Vector
    fixed: NDArray[np.int64]
    upper: NDArray[np.int64]
    lower: NDArray[np.int64]
    saddle: Factorise  #: of P, and the rows of A and G

    def C(self, x: Vector) -> Vector:
        """Return Cx."""
        return np.concatenate([self.G @ x, x[self.upper], -x[self.lower]])

    def C_T(self, z: Vector) -> Vector:
        """Return Cᵀz."""
        p = self.G.shape[0]
        return self._box_T(z[p:], start=self.G_T @ z[:p])

    def _box_T(self, z: Vector, *, start: Vector, lower: float = -1.0) -> Vector:
        """Add the multipliers of bounds to a force.

        lower : sign of those of lower bounds
        """
        start[self.upper] += z[: self.upper.size]
        start[self.lower] += lower * z[self.upper.size :]
        return start

    def factorised(self, w: Vector) -> Solve:
        """Prepare to solve for (dx, dy, dz) given diag(w) = S/Z.

        The rows of bounds are eliminated: they add 1/w to the diagonal of P.
        """
        n, m, p = self.qp.q.size, self.b.size, self.qp.h.size
        w_box = w[p:]
        solve = self.saddle(
            self._box_T(1 / w_box, start=np.full(n, DELTA), lower=1.0),
            np.append(np.full(m, DELTA), w[:p]),
        )

        def whole(r: Vector, t: Vector) -> tuple[Vector, Vector]:
            t_box = t[m + p :]
            r = self._box_T(t_box / w_box, start=r.copy())
            dx, rest = solve(r, t[: m + p])
            box = np.append(dx[self.upper], -dx[self.lower])
            return dx, np.append(rest, (box - t_box) / w_box)

        return whole

    def solution(self, at: Iterate) -> Solution:
        """Give the point in the terms of the QP."""
        m, p = self.qp.b.size, self.qp.h.size
        z_box = np.zeros(at.x.size)
        z_box[self.fixed] = at.y[m:]
        z_box[self.upper] += at.z[p : p + self.upper.size]
        z_box[self.lower] -= at.z[p + self.upper.size :]
        return Solution(
            status=Status.SOLVED, x=at.x, y=at.y[:m], z=at.z[:p], z_box=z_box
        )


@np.errstate(all="ignore")  # what diverges is not finite, and is seen
def interior_point(qp: QP) -> Solution:
    """Find a point of small KKT residuals, strictly inside of all inequalities.

    Best for a QP whose largest entries are about one (`equilibrate`).
    Where there is no solution, the point is the best of what was met.
    """
    problem = _problem(qp)
    best, least, waited = Solution.without_point(qp, Status.FAILED), np.inf, 0
    try:
        at = _start(problem)
        for k in range(MOST):
            point = replace(problem.solution(at), iterations=k)
            worst = kkt_residuals(qp, point).worst
            waited = 0 if worst < least / 2 else waited + 1
            if worst < least:
                best, least = point, worst
            if least <= CLOSE or waited == PATIENCE or not np.isfinite(worst):
                break
            at = _step(problem, at)
    except ArithmeticError:  # a step too far: the best point is what is left
        pass
    return best


def _problem(qp: QP) -> _Problem:
    is_fixed = qp.lb == qp.ub
    fixed, upper, lower = (
        np.flatnonzero(mask)
        for mask in (
            is_fixed, np.isfinite(qp.ub) & ~is_fixed, np.isfinite(qp.lb) & ~is_fixed
        )
    )  # fmt: skip
    unit = eye_array(qp.q.size, format="csr")
    A: Matrix = csr_array(vstack([csr_array(qp.A), unit[fixed]]))
    stack = vstack
    if isinstance(qp.P, np.ndarray):
        A, stack = A.toarray(), np.vstack
    G = csr_array(qp.G)
    return _Problem(
        qp=qp, A=A, b=np.append(qp.b, qp.lb[fixed]), G=G, G_T=G.T,
        d=np.concatenate([qp.h, qp.ub[upper], -qp.lb[lower]]),
        fixed=fixed, upper=upper, lower=lower, saddle=saddle(qp.P, stack([A, qp.G])),
    )  # fmt: skip


def _start(problem: _Problem) -> Iterate:
    """Minimise with ½|Cx − d|² for the inequalities, then shift s and z inside.

    As Vandenberghe (2010, The CVXOPT linear and quadratic cone program solvers, 5.3).
    """
    qp, m = problem.qp, problem.b.size
    solve = problem.factorised(np.ones(problem.d.size))
    x, rest = solve(-qp.q, np.append(problem.b, problem.d))
    y, z = rest[:m], rest[m:]
    unit = float(np.abs(z).max(initial=0.0)) or 1.0
    s, z = (v + max(0.0, unit - v.min(initial=unit)) for v in (-z, z))
    return Iterate(x, y, z, s)


def _step(problem: _Problem, at: Iterate) -> Iterate:
    """Predict, centre and correct."""
    qp, A, C, m = problem.qp, problem.A, problem.C, problem.b.size
    x, y, z, s = at
    r_d = qp.P @ x + qp.q + A.T @ y + problem.C_T(z)
    r_p, r_c = A @ x - problem.b, C(x) + s - problem.d
    solve = problem.factorised(s / z)

    def direction(r_sz: Vector) -> Iterate:
        dx, rest = solve(-r_d, np.append(-r_p, r_sz / z - r_c))
        return Iterate(dx, rest[:m], rest[m:], -r_c - C(dx))

    step = direction(s * z)
    if z.size:
        mu, length = s @ z / z.size, _length(at, step)
        affine = (s + length * step.s) @ (z + length * step.z) / z.size
        step = direction(s * z + step.s * step.z - (affine / mu) ** 3 * mu)
    length = min(1.0, KEEP * _length(at, step))
    return Iterate(*(v + length * dv for v, dv in zip(at, step, strict=True)))


def _length(at: Iterate, step: Iterate) -> float:
    """Give the longest step, at most 1/KEEP, that keeps s and z nonnegative."""
    lengths = [-v[dv < 0] / dv[dv < 0] for v, dv in ((at.s, step.s), (at.z, step.z))]
    return float(np.concatenate(lengths).min(initial=1 / KEEP))
