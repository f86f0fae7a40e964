"""OSQP, an operator-splitting method.

Reference: B. Stellato et al., OSQP: an operator splitting solver for quadratic
programs, Math. Program. Comput. 12 (2020) 637-672.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import eye_array, triu, vstack

from harness import QP, Solution, Status
from solvers.conversion import (
    NEGLIGIBLE,
    csc,
    needs_matrices,
    on_present_bounds,
    positive,
)

CLAIMS = {
    "OSQP_SOLVED": Status.SOLVED,
    "OSQP_MAX_ITER_REACHED": Status.ITERATION_LIMIT,
    "OSQP_SOLVED_INACCURATE": Status.ITERATION_LIMIT,  # at the limit, 10·tol holds
    "OSQP_TIME_LIMIT_REACHED": Status.TIME_LIMIT,
    "OSQP_PRIMAL_INFEASIBLE": Status.INFEASIBLE,
    "OSQP_DUAL_INFEASIBLE": Status.INFEASIBLE,
}  #: anything else is FAILED


@dataclass(frozen=True)
class OSQP:
    """https://osqp.org, in its own algebra (QDLDL), one thread.

    OSQP stops when the max norms of the primal and dual residuals and the duality gap
    are below eps_abs + eps_rel·(their largest term). That is the harness's relative
    test, so eps_rel = tol and eps_abs is negligible. It looks every 25 iterations only.
    Bounds become rows of the identity, for variables that have one.
    """

    max_iter: int = 1_000_000
    polishing: bool = False

    def __post_init__(self) -> None:
        positive(max_iter=self.max_iter)

    def declines(self, qp: QP) -> str | None:
        return needs_matrices(qp)

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        import osqp

        m, p, n = qp.b.size, qp.h.size, qp.q.size
        boxed = np.isfinite(qp.lb) | np.isfinite(qp.ub)
        rows = vstack([csc(qp.A), csc(qp.G), eye_array(n, format="csr")[boxed]])
        solver = osqp.OSQP(algebra="builtin")
        solver.setup(
            csc(triu(csc(qp.P))), qp.q,
            csc(rows),
            np.concatenate([qp.b, np.full(p, -np.inf), qp.lb[boxed]]),
            np.concatenate([qp.b, qp.h, qp.ub[boxed]]),
            eps_abs=NEGLIGIBLE, eps_rel=tol, check_dualgap=True,
            max_iter=self.max_iter, polishing=self.polishing, verbose=False,
        )  # fmt: skip

        def solve() -> Solution:
            r = solver.solve(raise_error=False)
            name = osqp.SolverStatus(r.info.status_val).name
            status = CLAIMS.get(name, Status.FAILED)
            if status is Status.INFEASIBLE:
                return Solution.without_point(qp, status, r.info.status)
            z_box = np.zeros(n)
            z_box[boxed] = r.y[m + p :]
            return Solution(
                status=status,
                x=r.x, y=r.y[:m], z=r.y[m : m + p], z_box=on_present_bounds(qp, z_box),
                iterations=r.info.iter, counts={"rho_updates": r.info.rho_updates},
                message=r.info.status,
            )  # fmt: skip

        return solve
