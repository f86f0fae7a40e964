"""HiGHS, an active-set and an interior-point method for QPs.

Reference: Q. Huangfu, J. A. J. Hall, Parallelizing the dual revised simplex method,
Math. Program. Comput. 10 (2018) 119-142; its QP solvers: https://highs.dev.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np
from scipy.sparse import csc_matrix, tril, vstack

from mortarbench.harness import (
    NO_SOLUTION,
    QP,
    About,
    Solution,
    Status,
    Vector,
    needs_matrices,
)
from mortarbench.solvers.common.adapter import Adapter
from mortarbench.solvers.common.conversion import (
    check_choice,
    csc,
    needs_dense,
    objective_factor,
    on_present_bounds,
)

PRIMAL = "kInfeasible"  #: status that may have a certificate of infeasibility
CLAIMS = {
    "kOptimal": Status.SOLVED,
    "kIterationLimit": Status.ITERATION_LIMIT,
    "kTimeLimit": Status.TIME_LIMIT,
    PRIMAL: Status.INFEASIBLE,
    "kUnbounded": Status.UNBOUNDED,
    "kUnboundedOrInfeasible": Status.INFEASIBLE,
}  #: all other statuses count as FAILED
MIN_TOLERANCE = 1e-10  #: smallest tolerance that HiGHS accepts
MIN_ENTRY = 1e-12  #: smallest value of small_matrix_value that HiGHS accepts


@dataclass(frozen=True)
class HiGHS(Adapter):
    """https://highs.dev, with one thread and the method qpasm or hipo.

    HiGHS tests violations and multiplier signs in absolute terms. Therefore the
    objective is scaled to ‖q‖∞ = 1. All tolerances are set to tol/100, but at least to
    1e-10, the smallest value that HiGHS accepts. An active-set method needs few
    additional steps for this accuracy.

    The adapter works around three properties of HiGHS. If a QP has bounds but no rows,
    qpasm claims an optimum after 0 iterations, so the adapter adds a free row. HiGHS
    adds qp_regularization_value (default 1e-7) to the diagonal of the Hessian, which
    causes residuals of 1e-6 on a singular QP of order one; the adapter sets this option
    to 0. HiGHS drops entries below small_matrix_value (default 1e-9); the adapter sets
    1e-12.
    """

    method: str = "qpasm"  #: "qpasm" (active set) or "hipo" (interior point)
    max_iter: int = 1_000_000

    about: ClassVar[About] = About(
        title="HiGHS",
        method="active set (qpasm) or interior point (hipo)",
        licence="MIT; highspy-extras (hipo) Apache-2.0",
        package="highspy",
        linear_solver="LU of the active rows and a dense reduced Hessian (qpasm); "
        "multifrontal LDLᵀ (hipo)",
        phases="passing the model (preparing); everything else (solving)",
        limits=(
            "qpasm takes longer than 20 s on the 4420 unknowns of "
            "beam-ring/Nr=12/Nh=6/primal (suites/fleet.toml).",
            "At tol 1e-9, hipo ends with kUnknown on beam-ring/Nr=30/Nh=15/primal, "
            "with residuals of 5e-12.",
            "qpasm ends with kSolveError if lengths are scaled by 1e-3, which "
            "increases the entries of the Hessian by 1e6 "
            "(tests/solvers/test_solvers.py), and on "
            "hertz-cylinder/friction=coulomb/mu=0.3/Q=0.5/dual, where the condition "
            "number of F is 260 (suites/friction.toml).",
            "Without the free row, the result for a membrane of 225 nodes has a "
            "residual of 1 (HiGHS 1.15.1); the conformance check 'finds where a "
            "membrane of 400 nodes touches' tests for this error.",
            "Without highspy-extras, HiGHS silently runs qpasm instead of hipo; the "
            "adapter therefore declines.",
            "qpasm stores a dense Hessian on the null space of the active rows. A QP "
            "is declined if a dense Hessian of all variables would not fit into "
            "memory.",
        ),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("method", self.method, ("qpasm", "hipo"))

    def declines(self, qp: QP) -> str | None:
        if self.method == "qpasm":
            return needs_dense(qp, 1)
        if find_spec("highspy_extras") is None:  # HiGHS would run qpasm instead
            return "not installed: highspy_extras (pip install highspy-extras)"
        return needs_matrices(qp)

    def library(self) -> Any:
        import highspy

        return highspy.Highs().getOptions()

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        import highspy

        if self.method == "hipo":
            import highspy_extras  # noqa: F401  # HiGHS finds hipo after this import

        scale = objective_factor(qp, 1.0)
        solver = highspy.Highs()
        for name, value in self._options(tol).items():
            if solver.setOptionValue(name, value) != highspy.HighsStatus.kOk:
                message = f"HiGHS refuses {name} = {value}"
                return lambda: Solution.without_point(qp, Status.FAILED, message)
        solver.passModel(_model(highspy, qp, scale))

        def solve() -> Solution:
            solver.run()
            info, name = solver.getInfo(), solver.getModelStatus().name
            status = CLAIMS.get(name, Status.FAILED)
            point = solver.getSolution()
            m, p = qp.b.size, qp.h.size
            if status in NO_SOLUTION or not point.value_valid:
                ray: dict[str, Vector] = {}
                _, has_ray, row = solver.getDualRay()
                if name == PRIMAL and has_ray and m + p:
                    y, z = -row[:m], -row[m:]
                    ray = dict(y=y, z=z, z_box=-(qp.A.T @ y + qp.G.T @ z))
                return Solution.without_point(qp, status, name, **ray)
            row = -np.array(point.row_dual) / scale
            z_box = -np.array(point.col_dual) / scale
            steps = {"qpasm": info.qp_iteration_count, "hipo": info.ipm_iteration_count}
            return Solution(
                status=status,
                x=np.array(point.col_value),
                y=row[:m],
                z=row[m : m + p],
                z_box=on_present_bounds(qp, z_box),
                iterations=steps[self.method],
                message=name,
                reported={
                    "linear_solver": "lu, dense reduced hessian"
                    if self.method == "qpasm"
                    else "hipo",
                    "solve_seconds": solver.getRunTime(),
                },
            )

        return solve

    def _options(self, tol: float) -> dict[str, Any]:
        eps = max(tol / 100, MIN_TOLERANCE)
        return self.tuned(
            output_flag=False,
            threads=1,
            solver=self.method,
            kkt_tolerance=eps,
            ipm_optimality_tolerance=eps,
            qp_regularization_value=0.0,
            small_matrix_value=MIN_ENTRY,
            qp_iteration_limit=self.max_iter,
            ipm_iteration_limit=self.max_iter,
            qp_nullspace_limit=2**31 - 1,
        )


def _model(highspy: Any, qp: QP, scale: float) -> Any:
    """Return `qp` as a HighsModel, with one free row if `qp` has no rows."""
    n = qp.q.size
    rows = csc(vstack([csc(qp.A), csc(qp.G)]))
    low = np.concatenate([qp.b, np.full(qp.h.size, -np.inf)])
    high = np.concatenate([qp.b, qp.h])
    if not low.size:
        rows = csc_matrix(([1.0], ([0], [0])), shape=(1, n))
        low, high = np.array([-np.inf]), np.array([np.inf])
    model = highspy.HighsModel()
    lp, hessian, P = model.lp_, model.hessian_, csc(tril(csc(qp.P))) * scale
    lp.num_col_, lp.num_row_ = n, low.size
    lp.col_cost_, lp.col_lower_, lp.col_upper_ = qp.q * scale, qp.lb, qp.ub
    lp.row_lower_, lp.row_upper_ = low, high
    lp.a_matrix_.format_ = highspy.MatrixFormat.kColwise
    lp.a_matrix_.num_col_, lp.a_matrix_.num_row_ = n, low.size
    lp.a_matrix_.start_, lp.a_matrix_.index_ = rows.indptr, rows.indices
    lp.a_matrix_.value_ = rows.data
    hessian.dim_, hessian.format_ = n, highspy.HessianFormat.kTriangular
    hessian.start_, hessian.index_ = P.indptr, P.indices
    hessian.value_ = P.data
    return model


HIPO = HiGHS(method="hipo")
