"""Template for a QP solver: replace the calls of Clarabel with your method or library.

    mortarbench test-solver NAME --plugin NAME.py
    mortarbench solve beam-ring/Nr=4/Nh=3/dual --solver NAME --plugin NAME.py

A solver receives the QP

    minimise ½xᵀPx + qᵀx   subject to   Ax = b,  Gx ≤ h,  lb ≤ x ≤ ub,

in which absent constraints have no rows and absent bounds are ±inf. It returns x and
multipliers y, z and z_box with

    Px + q + Aᵀy + Gᵀz + z_box = 0,   z ≥ 0,

where z_box ≤ 0 at active lower bounds, z_box ≥ 0 at active upper bounds and z_box = 0
otherwise. The harness verifies every answer independently.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import clarabel
import numpy as np
from scipy.sparse import csc_matrix, eye_array, triu, vstack

from mortarbench.harness import QP, Solution, Status, needs_matrices

STATUS = {
    "Solved": Status.SOLVED,
    "MaxIterations": Status.ITERATION_LIMIT,
    "PrimalInfeasible": Status.INFEASIBLE,
    "DualInfeasible": Status.UNBOUNDED,
}  #: all other statuses count as FAILED


@dataclass(frozen=True)
class Solver:
    """Interior-point method of the library Clarabel."""

    max_iter: int = 200  #: each field is an option of the solver: --option max_iter=50

    def __post_init__(self) -> None:
        if self.max_iter < 1:
            raise ValueError(f"max_iter = {self.max_iter}; expected at least 1")

    def declines(self, qp: QP) -> str | None:
        """Return the reason why this solver cannot solve `qp`, or None if it can."""
        return needs_matrices(qp)  # P may be an operator without a matrix

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        """Convert the QP; return a function that solves it. Both steps are timed."""
        # write all constraints as Cx + s = d, with s = 0 for equality rows, else s ≥ 0
        up, low = np.isfinite(qp.ub), np.isfinite(qp.lb)
        eye = eye_array(qp.q.size, format="csr")
        parts = (qp.A, qp.G, eye[up], -eye[low])
        C = csc_matrix(vstack([csc_matrix(M) for M in parts]))
        d = np.concatenate([qp.b, qp.h, qp.ub[up], -qp.lb[low]])
        m = qp.b.size
        cones = [clarabel.ZeroConeT(m), clarabel.NonnegativeConeT(d.size - m)]
        settings = clarabel.DefaultSettings()
        settings.verbose, settings.max_iter = False, self.max_iter
        settings.tol_feas = settings.tol_gap_abs = settings.tol_gap_rel = tol
        # the tolerances are absolute for a small objective, so it is scaled
        scale = 1e4 / (np.abs(qp.q).max(initial=0.0) or 1e4)
        P = csc_matrix(triu(csc_matrix(qp.P))) * scale
        solver = clarabel.DefaultSolver(P, qp.q * scale, C, d, cones, settings)

        def solve() -> Solution:
            found = solver.solve()
            status = STATUS.get(str(found.status), Status.FAILED)
            if status not in (Status.SOLVED, Status.ITERATION_LIMIT):
                return Solution.without_point(qp, status, str(found.status))
            multipliers = np.array(found.z) / scale
            ends = np.cumsum([m, qp.h.size, up.sum()])
            y, z, z_ub, z_lb = np.split(multipliers, ends)
            z_box = np.zeros(qp.q.size)
            z_box[up] += z_ub
            z_box[low] -= z_lb
            return Solution(
                status=status, x=np.array(found.x), y=y, z=z, z_box=z_box,
                iterations=found.iterations, message=str(found.status),
            )  # fmt: skip

        return solve


SOLVERS = {"NAME": Solver()}
