"""OSQP, an operator-splitting method.

Reference: B. Stellato et al., OSQP: an operator splitting solver for quadratic
programs, Math. Program. Comput. 12 (2020) 637-672.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from scipy.sparse import triu

from mortarbench.harness import NO_SOLUTION, QP, About, Solution, Status
from mortarbench.solvers.common.adapter import SequenceAdapter
from mortarbench.solvers.common.conversion import (
    NEGLIGIBLE,
    csc,
    from_two_sided,
    objective_factor,
    to_two_sided,
    two_sided,
)
from mortarbench.solvers.common.sequence import Session

PRIMAL = "OSQP_PRIMAL_INFEASIBLE"  #: status with a certificate of infeasibility
CLAIMS = {
    "OSQP_SOLVED": Status.SOLVED,
    "OSQP_MAX_ITER_REACHED": Status.ITERATION_LIMIT,
    # at the iteration limit, residuals below 10·tol
    "OSQP_SOLVED_INACCURATE": Status.ITERATION_LIMIT,
    "OSQP_TIME_LIMIT_REACHED": Status.TIME_LIMIT,
    PRIMAL: Status.INFEASIBLE,
    "OSQP_DUAL_INFEASIBLE": Status.UNBOUNDED,
}  #: all other statuses count as FAILED


@dataclass(frozen=True)
class OSQP(SequenceAdapter):
    """https://osqp.org, with its built-in linear algebra (QDLDL) and one thread.

    OSQP stops when the max norms of the primal and dual residuals and the duality gap
    are each below eps_abs + eps_rel·(their largest term). With eps_rel = tol and a
    negligible eps_abs, this test is relative, like the test of the harness. OSQP
    evaluates the test every 25 iterations. Each bounded variable becomes a row of the
    identity.

    If the dual residual is below 1e-10 (absolute) before polishing, OSQP accepts any
    dual residual after polishing. With polishing, the objective is therefore scaled to
    ‖q‖∞ = 1e4.
    """

    max_iter: int = 1_000_000
    polishing: bool = False  #: finally solve with the active rows as equalities

    about: ClassVar[About] = About(
        title="OSQP",
        method="operator splitting (ADMM)",
        licence="Apache-2.0",
        package="osqp",
        linear_solver="QDLDL (sparse LDLᵀ), one factorisation per change of ρ",
        phases="scaling and factorisation (preparing); iterations and polishing "
        "(solving)",
        sequence="`update` replaces vectors and keeps the factors; starts from the "
        "last point",
        limits=(
            "Polishing increases residuals if the objective is small. Without the "
            "scaling, the dual residual was 3e-3 at tol 1e-6 for energies of 1e-6 "
            "(tests/solvers/test_solvers.py), and the gap was 3e-7 at tol 1e-9 on "
            "beam-ring/Nr=4/Nh=3/primal.",
        ),
    )

    def library(self) -> Any:
        import osqp

        ext = osqp.OSQP(algebra="builtin").ext
        settings = ext.OSQPSettings()
        ext.osqp_set_default_settings(settings)
        return settings

    def _begin(self, qp: QP, tol: float) -> Session:
        import osqp

        rows, low, high = two_sided(qp)
        scale = objective_factor(qp) if self.polishing else 1.0
        solver = osqp.OSQP(algebra="builtin")
        solver.setup(
            csc(triu(csc(qp.P))) * scale,
            qp.q * scale,
            rows,
            low,
            high,
            **self.tuned(
                eps_abs=NEGLIGIBLE,
                eps_rel=tol,
                check_dualgap=True,
                max_iter=self.max_iter,
                polishing=self.polishing,
                verbose=False,
            ),
        )

        def solve() -> Solution:
            r = solver.solve(raise_error=False)
            name = osqp.SolverStatus(r.info.status_val).name
            status = CLAIMS.get(name, Status.FAILED)
            if status in NO_SOLUTION:
                ray = from_two_sided(qp, r.prim_inf_cert) if name == PRIMAL else {}
                return Solution.without_point(qp, status, r.info.status, **ray)
            return Solution(
                status=status,
                x=r.x,
                **from_two_sided(qp, r.y / scale),
                iterations=r.info.iter,
                message=r.info.status,
                counts={"rho_updates": r.info.rho_updates},
                reported={
                    "linear_solver": "qdldl",
                    "setup_seconds": r.info.setup_time,
                    "solve_seconds": r.info.solve_time,
                    "polish_seconds": r.info.polish_time,
                },
            )

        def update(new: QP) -> None:
            _, low, high = two_sided(new)
            solver.update(q=new.q * scale, l=low, u=high)

        def start(s: Solution) -> None:
            solver.warm_start(x=s.x, y=to_two_sided(qp, s) * scale)

        return Session(solve, update, start)


POLISH = OSQP(polishing=True)
