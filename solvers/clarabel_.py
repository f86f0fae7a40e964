"""Clarabel, an interior-point method for conic programs.

Reference: P. J. Goulart, Y. Chen, Clarabel: an interior-point solver for conic programs
with quadratic objectives, arXiv:2405.12762 (2024).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import eye_array, triu, vstack

from harness import QP, Solution, Status
from solvers.conversion import csc, needs_matrices, positive

CLAIMS = {
    "Solved": Status.SOLVED,
    "MaxIterations": Status.ITERATION_LIMIT,
    "MaxTime": Status.TIME_LIMIT,
    "PrimalInfeasible": Status.INFEASIBLE,
    "DualInfeasible": Status.INFEASIBLE,
}  #: anything else (AlmostSolved, InsufficientProgress, …) is FAILED

OBJECTIVE_SIZE = 1e4  #: ‖q‖∞ as handed to Clarabel


@dataclass(frozen=True)
class Clarabel:
    """https://clarabel.org, one thread.

    Clarabel divides its residuals by max(1, size of their terms) and takes the gap as
    closed when it is below tol absolutely *or* relative to max(1, |objective|): for a
    QP with a small objective all that is absolute, and tol = 1e-6 leaves five digits
    fewer at an energy of 1e-5. Multiplying the objective until ‖q‖∞ = 1e4 makes each
    test the relative one where x is of order one, as in every QP emitted here, so that
    tol is passed on as it is. (The steps hardly change: Clarabel equilibrates the
    objective anyway.) In units that make x tiny, Clarabel may stop early.

    Equalities go to the zero cone; inequalities and finite bounds, one row each, to the
    nonnegative cone.
    """

    max_iter: int = 200

    def __post_init__(self) -> None:
        positive(max_iter=self.max_iter)

    def declines(self, qp: QP) -> str | None:
        return needs_matrices(qp)

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        import clarabel

        m, p, n = qp.b.size, qp.h.size, qp.q.size
        up, low = np.isfinite(qp.ub), np.isfinite(qp.lb)
        eye = eye_array(n, format="csr")
        rows = csc(vstack([csc(qp.A), csc(qp.G), eye[up], -eye[low]]))
        rhs = np.concatenate([qp.b, qp.h, qp.ub[up], -qp.lb[low]])
        cones = [clarabel.ZeroConeT(m), clarabel.NonnegativeConeT(rhs.size - m)]
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_threads = 1
        settings.max_iter = self.max_iter
        settings.tol_feas = settings.tol_gap_abs = settings.tol_gap_rel = tol
        scale = OBJECTIVE_SIZE / (np.abs(qp.q).max(initial=0.0) or OBJECTIVE_SIZE)
        P = csc(triu(csc(qp.P))) * scale
        solver = clarabel.DefaultSolver(P, qp.q * scale, rows, rhs, cones, settings)

        def solve() -> Solution:
            r = solver.solve()
            status = CLAIMS.get(str(r.status), Status.FAILED)
            if status is Status.INFEASIBLE:
                return Solution.without_point(qp, status, str(r.status))
            z = np.array(r.z) / scale
            z_up, z_low = np.split(z[m + p :], [up.sum()])
            z_box = np.zeros(n)
            z_box[up] += z_up
            z_box[low] -= z_low
            return Solution(
                status=status,
                x=np.array(r.x), y=z[:m], z=z[m : m + p], z_box=z_box,
                iterations=r.iterations, message=str(r.status),
            )  # fmt: skip

        return solve
