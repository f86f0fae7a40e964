"""Bounded-variable least squares (scipy), applied to a Cholesky factor of P.

With P = LLᵀ,  ½xᵀPx + qᵀx = ½‖Lᵀx + L⁻¹q‖² − ½‖L⁻¹q‖².  A strictly convex QP with
bounds is therefore a least-squares problem. If every variable that is not fixed has a
lower bound and none of them has an upper bound, this problem is solved by the
active-set method of Lawson and Hanson (Solving Least Squares Problems, 1974, Chapter
23). For other bounds, it is solved by the extension of this method by Stark and Parker
(Comput. Stat. 10, 1995).
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
    needs_matrices,
)
from mortarbench.solvers.common.conversion import check_positive, dense
from mortarbench.solvers.common.stopping import relative_residual

MAX_COMPONENTS = 5_000  #: largest accepted n, because P is converted to a dense matrix


@dataclass(frozen=True)
class BVLS:
    """scipy.optimize.nnls for lower bounds, lsq_linear(method="bvls") for other bounds.

    The free components of the resulting active set are recomputed by a direct solve.
    The tolerance passed to bvls is min(tol, 1e-10). The solver claims a solution if the
    relative KKT residual is at most tol. Fixed variables are eliminated. The objective
    is scaled, because the stopping test of bvls is absolute. scipy reports the number
    of iterations for bvls but not for nnls.
    """

    max_iter: int = 10_000

    about: ClassVar[About] = About(
        title="Bounded least squares (scipy)",
        licence="BSD-3-Clause",
        method="active set (`nnls` or `lsq_linear`), applied to a Cholesky factor",
        linear_solver="LAPACK, called by scipy",
        phases="factorisation of P (preparing); iterations (solving)",
        limits=("`nnls` does not report the number of iterations.",),
    )

    def __post_init__(self) -> None:
        check_positive(max_iter=self.max_iter)

    def declines(self, qp: QP) -> str | None:
        if qp.b.size or qp.h.size:
            return "accepts bounds only"
        if reason := needs_matrices(qp):
            return reason
        if qp.q.size > MAX_COMPONENTS:
            return (
                "converts P to a dense matrix; accepts at most "
                f"{MAX_COMPONENTS} components"
            )
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
    """Minimise ‖Cx − rhs‖ in the box; return x, active bounds and iterations.

    The second array contains −1 at the lower bound, 1 at the upper bound, otherwise 0.
    The number of iterations is None if scipy does not report it.
    """
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

    The multiplier of an active bound is the component of −(Px + q).
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
    if relative_residual(qp, point, tol) <= tol:
        return point
    message = "step limit, or no further progress in rounding"
    return replace(point, status=Status.ITERATION_LIMIT, message=message)
