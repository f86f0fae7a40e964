"""QOCO, an interior-point method for quadratic and second-order cone programs.

Reference: G. M. Chari, B. Açıkmeşe, QOCO: a quadratic objective conic optimizer with
custom solver generation, arXiv:2503.12658 (2025).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mortarbench.harness import QP, About, Solution, Status
from mortarbench.solvers.common.adapter import SequenceAdapter
from mortarbench.solvers.common.conversion import (
    CONIC_SETS,
    DIVERGED,
    NEGLIGIBLE,
    csc,
    objective_factor,
    to_cone,
)
from mortarbench.solvers.common.sequence import Session

CLAIMS = {
    "QOCO_SOLVED": Status.SOLVED,
    "QOCO_MAX_ITER": Status.ITERATION_LIMIT,
}  #: all other statuses (QOCO_SOLVED_INACCURATE, …) count as FAILED


@dataclass(frozen=True)
class QOCO(SequenceAdapter):
    """https://qoco-org.github.io/qoco.

    QOCO stops when the max norms of the residuals are each below abstol + reltol·(their
    largest term) and the gap is below abstol + reltol·max(1, |objective|). Therefore
    reltol = tol and abstol is negligible. The objective is scaled to ‖q‖∞ = 1e4, so
    that the 1 in the maximum has no effect. On an unbounded QP, the iterates grow until
    every relative residual is small, and QOCO claims success. A claimed solution with
    ‖x‖∞ > 1e12 therefore counts as failed.
    """

    max_iter: int = 200

    accepts: ClassVar[tuple[type, ...]] = CONIC_SETS
    about: ClassVar[About] = About(
        title="QOCO",
        method="interior point",
        licence="BSD-3-Clause",
        package="qoco",
        linear_solver="QDLDL (sparse LDLᵀ), one factorisation per iteration",
        phases="equilibration and symbolic analysis (preparing); all factorisations "
        "(solving)",
        sequence="`update_vector_data` keeps the analysis; no warm starts in Python "
        "(0.3.2)",
        limits=(
            "QOCO computes no certificates of infeasibility. In the conformance check "
            "'unbounded', it claims success with ‖x‖∞ = 1e16.",
        ),
    )

    def library(self) -> Any:
        import qoco

        ext = qoco.QOCO().ext
        settings = ext.QOCOSettings()
        ext.set_default_settings(settings)
        return settings

    def _begin(self, qp: QP, tol: float) -> Session:
        import qoco

        form, scale = to_cone(qp), objective_factor(qp)
        rows, rhs, m = form.rows, form.rhs, form.equalities
        k = rhs.size - m
        solver = qoco.QOCO()
        solver.setup(
            qp.q.size,
            k,
            m,
            csc(qp.P) * scale,
            qp.q * scale,
            csc(rows[:m]) if m else None,
            rhs[:m] if m else None,
            csc(rows[m:]) if k else None,
            rhs[m:] if k else None,
            form.inequalities,
            form.cones.size,
            form.cones.astype(np.int32),
            **self.tuned(
                abstol=NEGLIGIBLE,
                reltol=tol,
                abstol_inacc=NEGLIGIBLE,
                reltol_inacc=tol,
                max_iters=self.max_iter,
                verbose=0,
            ),
        )

        def solve() -> Solution:
            r = solver.solve()
            v = np.concatenate([np.ravel(r.y)[:m], np.ravel(r.z)[:k]]) / scale
            x, status = np.array(r.x), CLAIMS.get(r.status, Status.FAILED)
            if status is Status.SOLVED and np.abs(x).max() > DIVERGED:
                return Solution.without_point(qp, Status.FAILED, "diverged")
            return Solution(
                status=status,
                x=x,
                **form.multipliers(v),
                iterations=r.iters,
                message=r.status,
                counts={"refinement_steps": r.ir_iters},
                reported={
                    "linear_solver": "qdldl",
                    "setup_seconds": r.setup_time_sec,
                    "solve_seconds": r.solve_time_sec,
                },
            )

        def update(new: QP) -> None:
            rhs = to_cone(new).rhs
            solver.update_vector_data(
                new.q * scale, rhs[:m] if m else None, rhs[m:] if k else None
            )

        return Session(solve, update)
