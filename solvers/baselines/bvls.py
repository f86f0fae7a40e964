"""Bounded-variable least squares of scipy, on a Cholesky factor.

With P = LLᵀ,  ½xᵀPx + qᵀx = ½‖Lᵀx + L⁻¹q‖² − ½‖L⁻¹q‖².  A strictly convex QP with
bounds is therefore a least-squares problem. Problems with lower bounds only are solved
by the active-set method of Lawson and Hanson (Solving Least Squares Problems, 1974,
Chapter 23), others by the extension due to Stark and Parker (Comput. Stat. 10, 1995).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.linalg import LinAlgError, cholesky, solve_triangular

from mortarbench.harness import (
    QP,
    About,
    Solution,
    Status,
    Vector,
    kkt_residuals,
    needs_matrices,
)
from mortarbench.solvers.common.conversion import check_positive, dense

MAX_COMPONENTS = 5_000  #: limit of n, because P is converted to a dense matrix
CLAIM_FACTOR = (
    5.0  #: a point is reported as solved if its KKT residuals are ≤ this times tol
)


@dataclass(frozen=True)
class BVLS:
    """scipy.optimize.nnls for lower bounds, lsq_linear(method="bvls") for other bounds.

    Both routines end with the exact active set. `tol` bounds the optimality test of
    bvls, and a point is reported as solved if its KKT residuals are within 5·tol. Fixed
    variables are eliminated, and the objective is scaled, because the test of bvls is
    absolute. scipy reports the iterations of bvls but not those of nnls.
    """

    max_iter: int = 10_000

    about: ClassVar[About] = About(
        title="Bounded least squares (scipy)",
        licence="BSD-3-Clause",
        method="active set: `nnls` and `lsq_linear` on a Cholesky factor",
        linear_solver="LAPACK, within scipy",
        phases="preparing factorises P",
        limits=("`nnls` does not report its iterations",),
    )

    def __post_init__(self) -> None:
        check_positive(max_iter=self.max_iter)

    def declines(self, qp: QP) -> str | None:
        if qp.b.size or qp.h.size:
            return "takes bounds only"
        if reason := needs_matrices(qp):
            return reason
        if qp.q.size > MAX_COMPONENTS:
            return f"converts P to dense; takes at most {MAX_COMPONENTS} components"
        try:
            cholesky(dense(qp.P), overwrite_a=True, check_finite=False)
        except LinAlgError:
            return "needs a positive definite P"
        return None

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        P = dense(qp.P)
        moving = qp.lb < qp.ub
        base = np.where(np.isfinite(qp.lb), qp.lb, 0.0)
        slope = (P @ base + qp.q)[moving]
        scale = 2.0 ** np.frexp(np.abs(slope).max(initial=0.0))[1]
        L = cholesky(P[np.ix_(moving, moving)] / scale, lower=True)
        rhs = -solve_triangular(L, slope / scale, lower=True)
        box = (qp.lb - base)[moving], (qp.ub - base)[moving]

        def solve() -> Solution:
            x, side = base.copy(), np.full(base.size, -1)
            try:
                result = _least_squares(L.T, rhs, box, tol, self.max_iter)
            except RuntimeError as e:  # raised by nnls at its iteration limit
                return Solution.without_point(qp, Status.ITERATION_LIMIT, str(e))
            increment, side[moving], steps = result
            x[moving] += increment
            return _point(qp, P, x, side, steps, tol)

        return solve


def _least_squares(
    C: Vector, rhs: Vector, box: tuple[Vector, Vector], tol: float, limit: int
) -> tuple[Vector, Vector, int | None]:
    """Minimise ‖Cx − rhs‖ in the box; return x, active sides and iterations."""
    from scipy.optimize import lsq_linear, nnls

    if not rhs.size:
        return rhs, rhs, 0
    if not box[0].any() and np.isinf(box[1]).all():
        x, _ = nnls(C, rhs, maxiter=limit)
        return x, np.where(x > 0, 0, -1), None
    r = lsq_linear(C, rhs, box, method="bvls", tol=min(tol, 1e-10), max_iter=limit)
    return r.x, r.active_mask, int(r.nit)


def _point(
    qp: QP, P: Vector, x: Vector, side: Vector, steps: int | None, tol: float
) -> Solution:
    """Return the solution, with the free components recomputed by a direct solve.

    The multipliers of active bounds are the components of −(Px + q).
    """
    x = np.where(side < 0, qp.lb, np.where(side > 0, qp.ub, x))
    free = np.flatnonzero(side == 0)
    if free.size:
        x[free] -= np.linalg.solve(P[np.ix_(free, free)], (P @ x + qp.q)[free])
    z_box = np.where(side == 0, 0.0, -(P @ x + qp.q))
    point = Solution(
        status=Status.SOLVED,
        x=x,
        y=np.zeros(0),
        z=np.zeros(0),
        z_box=z_box,
        iterations=steps,
        message="converged",
    )
    if kkt_residuals(qp, point).worst <= CLAIM_FACTOR * tol:
        return point
    message = "step limit, or no further progress in rounding"
    return replace(point, status=Status.ITERATION_LIMIT, message=message)
