"""Reference solve of QPs over arbitrary convex sets that uses only projections.

Let M = [A; G; I], and C = {b} × {w ≤ h} × S with the product S of the sets. The QP is
to minimise ½xᵀPx + qᵀx subject to Mx ∈ C. Let Π be the projection onto C, and R > 0 a
diagonal matrix whose entries are equal within each set. Then a vector t of the size of
Mx defines both the point w = Π(t) in C and the multipliers λ = R(t − w), which are
normal to C at w. The remaining KKT conditions state that the normal map is zero
(Robinson 1992, Math. Oper. Res. 17),

    Px + q + MᵀR(t − Π(t)) = 0,      Mx = Π(t).                                    (1)

1. ADMM with penalty R approaches a zero of (1) from any starting point (Stellato et al.
   2020, Math. Prog. Comp. 12). If P is singular, ADMM needs Anderson acceleration with
   a safeguard (Zhang, O'Donoghue and Boyd 2020, SIAM J. Optim. 30).
2. Newton's method then converges to this zero. The derivative of Π is approximated by
   difference quotients, and residuals are evaluated in extended precision. The error √ε
   of the quotients affects only the rate of convergence: each step reduces the residual
   by about the factor √ε.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import lu_factor, lu_solve

from mortarbench.harness import QP, Solution, Status, Vector

ROUNDS = 12  #: rounds of ADMM and Newton's method, each with a different penalty
ADMM_STEPS = 400  #: ADMM steps in the first round; round k takes k times as many steps
NEWTON_STEPS = 30  #: largest number of Newton steps per round
MEMORY = 10  #: number of plain steps before an acceleration, which uses all of them
#: diagonal shift of the normal equations of an acceleration, relative to their trace
GRAM_SHIFT = 1e-10
RELAXATION = 1.6  #: over-relaxation of ADMM, the default of OSQP
#: penalty of rows of A relative to all other penalties, as in OSQP
EQUALITY_PENALTY = 1e3
MAX_PENALTY_CHANGE = 10.0  #: largest ratio of the penalties of two successive rounds
DIFFERENCE_STEP = 2.0**-26  #: √ε, the step of difference quotients relative to ‖t‖∞
#: relative diagonal shift of the Newton matrix, which regularises dependent rows; it
#: perturbs the steps, but not the zero of (1)
SHIFT = 1e-15


@dataclass(frozen=True, eq=False)
class _Problem:
    """A QP with the constraint Mx ∈ C."""

    qp: QP
    P: Any
    M: Any  #: (r, n) normalised rows of A and G, then I
    size: Vector  #: (m + p,) norms of the rows of A and G; 1 for a zero row

    @classmethod
    def of(cls, qp: QP) -> _Problem:
        rows = np.vstack([_dense(qp.A), _dense(qp.G)])
        size = np.linalg.norm(rows, axis=1)
        size[size == 0] = 1
        M = np.vstack([rows / size[:, None], np.eye(qp.q.size)])
        return cls(qp, _dense(qp.P), M, size)

    @property
    def largest(self) -> float:
        """Largest |entry| of P, used as a penalty in the units of P; 1 if P = 0."""
        return float(np.abs(self.P).max(initial=0)) or 1.0

    def penalty(self, rho: float) -> Vector:
        """Return R (r,): rho for rows of G and variables, 1000 rho for rows of A."""
        m = self.qp.b.size
        R: Vector = rho * np.ones(self.M.shape[0])
        R[:m] *= EQUALITY_PENALTY
        return R

    def project(self, t: Any) -> Any:
        """Return Π(t)."""
        m, k = self.qp.b.size, self.size.size
        x = t[k:]
        for one in self.qp.sets:
            x = one.project(x)
        b, h = self.qp.b / self.size[:m], self.qp.h / self.size[m:]
        return np.concatenate([b, np.minimum(t[m:k], h), x])

    def solution(self, t: Any, R: Vector) -> Solution:
        """Return the point Π(t) with the multipliers R(t − Π(t))."""
        k, w = self.size.size, self.project(t)
        force = R * (t - w)
        y, z = np.split((force[:k] / self.size).astype(float), [self.qp.b.size])
        return Solution(
            status=Status.SOLVED,
            x=w[k:].astype(float),
            y=y,
            z=z,
            z_box=force[k:].astype(float),
        )


def refine(qp: QP, start: Solution) -> Solution:
    """Refine a point near a solution by Newton's method; return the refined point."""
    problem = _Problem.of(qp)
    R = problem.penalty(problem.largest)
    forces = np.concatenate([np.append(start.y, start.z) * problem.size, start.z_box])
    t = problem.M @ start.x + forces / R
    return replace(
        problem.solution(_newton(problem, R, t), R), iterations=start.iterations
    )


def projection_iterates(qp: QP) -> Iterator[Solution]:
    """Yield the point after each round; later rounds take more steps."""
    problem = _Problem.of(qp)
    P, M, project, q = problem.P, problem.M, problem.project, qp.q
    rho = problem.largest
    t, multipliers = np.zeros(len(M)), np.zeros(len(M))
    for number in range(1, ROUNDS + 1):
        R = problem.penalty(rho)
        t = project(t) + multipliers / R
        K = lu_factor(P + M.T @ (R[:, None] * M))

        def primal_point(t: Vector, R: Vector = R, K: Any = K) -> Vector:
            x: Vector = lu_solve(K, M.T @ (R * (2 * project(t) - t)) - q)
            return x

        t = _fixed_point(
            lambda t: t + RELAXATION * (M @ primal_point(t) - project(t)),
            t,
            ADMM_STEPS * number,
        )
        x, w = primal_point(t), project(t)
        multipliers = R * (t - w)
        yield problem.solution(_newton(problem, R, t), R)
        # multiply the penalty by √(primal/dual) to balance the residuals, as in OSQP
        primal = np.abs(M @ x - w).max() / max(np.abs(w).max(), np.abs(M @ x).max())
        forces = [P @ x, q, M.T @ multipliers]
        dual = np.abs(sum(forces)).max() / max(np.abs(f).max() for f in forces)
        change = float(np.sqrt(primal / dual))
        rho *= min(max(change, 1 / MAX_PENALTY_CHANGE), MAX_PENALTY_CHANGE)


def _fixed_point(step: Callable[[Vector], Vector], t: Vector, count: int) -> Vector:
    """Iterate t ← step(t) `count` times, with an acceleration every `MEMORY` steps.

    The image of an accelerated point replaces t only if the residual ‖step(t) − t‖ of
    this point is not larger than the last residual. The residual of plain steps never
    increases, because `step` is an averaged operator.
    """
    images, changes = list[Vector](), list[Vector]()
    for _ in range(count // MEMORY):
        images.clear()
        changes.clear()
        for _ in range(MEMORY):
            image = step(t)
            images.append(image)
            changes.append(image - t)
            t = image
        F, G = (np.diff(np.array(rows), axis=0).T for rows in (changes, images))
        gram = F.T @ F
        gram[np.diag_indices_from(gram)] += GRAM_SHIFT * np.trace(gram)
        try:
            weights = np.linalg.solve(gram, F.T @ changes[-1])
        except np.linalg.LinAlgError:  # the changes are zero
            return t
        candidate = t - G @ weights
        image = step(candidate)
        if np.linalg.norm(image - candidate) <= np.linalg.norm(changes[-1]):
            t = image
    return t


@np.errstate(all="ignore")  # a residual that is not finite ends the loop
def _newton(problem: _Problem, R: Vector, t: Vector) -> Any:
    """Run Newton's method for (1) from t; return the iterate with the least residual.

    The unknown x is eliminated, because x consists of the components of Π(t) for the
    rows of I. Therefore t is the only unknown.
    """
    P, M, q, k = problem.P, problem.M, problem.qp.q, problem.size.size
    t, rows = t.astype(np.longdouble), M[:k]
    P_x, M_x = P.astype(np.longdouble), M.astype(np.longdouble)
    best, least = t, np.inf
    for _ in range(NEWTON_STEPS):
        w = problem.project(t)
        x = w[k:]
        Px = P_x @ x
        F = np.concatenate([M_x[:k] @ x - w[:k], Px + q + M_x.T @ (R * (t - w))])
        sizes = np.abs(w).max(), np.abs(Px).max() + np.abs(q).max()
        scale = np.repeat(sizes, [k, q.size])
        size = float(np.abs(F / np.where(scale > 0, scale, 1)).max(initial=0))
        if not size < least:
            break
        best, least = t, size
        D = _derivative(problem.project, t.astype(float))
        D_x, off = D[k:, k:], M.T @ (R[:, None] * (np.eye(t.size) - D))
        J = np.block([[-D[:k, :k], rows @ D_x], [off[:, :k], P @ D_x + off[:, k:]]])
        J += SHIFT * np.diag(np.repeat([-1.0, problem.largest], [k, q.size]))
        try:
            step = np.linalg.solve(J, F.astype(float))
        except np.linalg.LinAlgError:  # a pivot is zero
            break
        t = t - step
    return best


def _derivative(project: Any, t: Vector) -> Any:
    """Return the central difference quotients of Π at t, one column per component."""
    D = np.empty((t.size, t.size))
    for j, at in enumerate(t):
        h = DIFFERENCE_STEP * max(abs(at), float(np.abs(t).max()) or 1.0)
        there, here = t.copy(), t.copy()
        there[j], here[j] = at + h, at - h
        D[:, j] = (project(there) - project(here)) / (there[j] - here[j])
    return D


def _dense(M: Any) -> Any:
    return M.toarray() if hasattr(M, "toarray") else np.asarray(M)
