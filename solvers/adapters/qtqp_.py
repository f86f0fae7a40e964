"""QTQP, a primal-dual interior-point method with exchangeable linear algebra.

Reference: https://github.com/google-deepmind/qtqp.
"""

from __future__ import annotations

from dataclasses import dataclass
from inspect import signature
from typing import Any, ClassVar

import numpy as np

from mortarbench.harness import (
    QP,
    About,
    Solution,
    Status,
    Vector,
    needs_matrices,
)
from mortarbench.solvers.common.adapter import SequenceAdapter, concluded
from mortarbench.solvers.common.conversion import (
    check_choice,
    csc,
    objective_factor,
    to_cone,
)
from mortarbench.solvers.common.sequence import Session

CLAIMS = {
    "solved": Status.SOLVED,
    "hit_max_iter": Status.ITERATION_LIMIT,
    "infeasible": Status.INFEASIBLE,
    "unbounded": Status.UNBOUNDED,
}  #: all other statuses (almost_solved, …) count as FAILED
LINEAR_SOLVERS = ("pardiso", "scipy", "scipy_dense")


@dataclass(frozen=True)
class QTQP(SequenceAdapter):
    """https://github.com/google-deepmind/qtqp.

    QTQP divides each residual by max(1, size of its terms). The gap must be below tol,
    either in absolute terms or relative to max(1, |objective|). Therefore the objective
    is scaled to ‖q‖∞ = 1e4, so that the 1 in the maximum has no effect, and tol is
    passed unchanged.

    In sequences, QTQP shifts the last point into the interior and starts there if the
    residuals are small enough; otherwise it uses its default starting point. If a last
    point was passed, the count `accepted_starts` is 1 if QTQP used it, otherwise 0.
    """

    linear_solver: str = "pardiso"  #: "pardiso" (MKL), "scipy" (SuperLU), "scipy_dense"
    max_iter: int = 100

    about: ClassVar[About] = About(
        title="QTQP",
        method="interior point (homogeneous embedding)",
        licence="Apache-2.0",
        package="qtqp",
        linear_solver="MKL Pardiso (py-mkl-pardiso), one factorisation per iteration",
        phases="conversion only (preparing); everything else (solving)",
        sequence="starts from the last point if QTQP accepts it",
        limits=(
            "QTQP needs an inequality row or a bound, because otherwise it divides by "
            "zero.",
            "At tol 1e-9, QTQP stagnates with a relative gap of 1.1e-9, near the "
            "solution of beam-ring/Nr=30/Nh=15/primal, and ends at its iteration "
            "limit. On hertz-cylinder/friction=coulomb/mu=0.3/Q=0.5/dual, the "
            "complementarity of the claimed point is 2.0e-8, twice the limit for a "
            "verified point.",
            "The complementarity of a claimed point may exceed 10·tol: on "
            "beam-ring/Nr=12/Nh=6/dual it is 1.3e-5 at tol 1e-6 (step 4 of a "
            "sequence) and 1.7e-7 at tol 1e-8 (step 5, cold start).",
        ),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("linear_solver", self.linear_solver, LINEAR_SOLVERS)

    def declines(self, qp: QP) -> str | None:
        if not qp.sizes["inequalities"] + qp.sizes["bounds"]:
            return "needs an inequality row or a bound"
        return needs_matrices(qp)

    def library(self) -> Any:
        import qtqp

        parameters = signature(qtqp.QTQP.solve).parameters
        return {name: p.default for name, p in parameters.items() if name != "self"}

    def _begin(self, qp: QP, tol: float) -> Session:
        import qtqp

        form = to_cone(qp)
        scale = objective_factor(qp)
        kind = qtqp.LinearSolver[self.linear_solver.upper()]
        solver = qtqp.QTQP(
            a=form.rows, b=form.rhs, c=qp.q * scale, z=qp.b.size, p=csc(qp.P) * scale
        )
        start: tuple[Vector, Vector, Vector] | None = None

        def solve() -> Solution:
            r = solver.solve(
                warm_start=start,
                **self.tuned(
                    tol_feas=tol,
                    tol_gap_abs=tol,
                    tol_gap_rel=tol,
                    linear_solver=kind,
                    max_iter=self.max_iter,
                    collect_stats=True,
                    verbose=False,
                ),
            )
            message = r.status.value
            return concluded(
                qp,
                CLAIMS.get(message, Status.FAILED),
                message,
                form.multipliers(np.array(r.y) / scale),
                x=np.array(r.x),
                iterations=len(r.stats) - 1,
                counts={"accepted_starts": int(solver.warm_accepted)} if start else {},
                reported={"linear_solver": self.linear_solver},
            )

        def start_at(s: Solution) -> None:
            nonlocal start
            # start from the slack s = r − Rx with the rows R, r of this QP, because the
            # previous slack belongs to the rows of the previous QP
            x, y, slack = form.point(s)
            start = x, y * scale, slack

        return Session(solve, start=start_at)
