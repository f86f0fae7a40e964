"""PIQP, a proximal interior-point method.

Reference: R. Schwan et al., PIQP: a proximal interior-point quadratic programming
solver, Proc. 62nd IEEE Conf. Decision and Control (2023) 1088-1093.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from mortarbench.harness import QP, About, Solution, Status, needs_matrices
from mortarbench.solvers.common.adapter import SequenceAdapter, concluded
from mortarbench.solvers.common.conversion import (
    NEGLIGIBLE,
    check_choice,
    csc,
    dense,
    needs_dense,
    objective_factor,
    resolve_backend,
)
from mortarbench.solvers.common.sequence import Session

CLAIMS = {
    "PIQP_SOLVED": Status.SOLVED,
    "PIQP_MAX_ITER_REACHED": Status.ITERATION_LIMIT,
    "PIQP_PRIMAL_INFEASIBLE": Status.INFEASIBLE,
    "PIQP_DUAL_INFEASIBLE": Status.UNBOUNDED,
}  #: all other statuses count as FAILED


@dataclass(frozen=True)
class PIQP(SequenceAdapter):
    """https://predict-epfl.github.io/piqp.

    PIQP stops when the max norms of the residuals and the duality gap are each below
    eps_abs *or* below eps_rel·max(1, their largest term). Therefore eps_rel = tol and
    eps_abs is negligible. The objective is scaled to ‖q‖∞ = 1e4, so that the 1 in the
    maximum has no effect.
    """

    backend: Literal["auto", "dense", "sparse"] = "auto"  #: auto: dense if P is dense
    max_iter: int = 250

    about: ClassVar[About] = About(
        title="PIQP",
        method="interior point (proximal)",
        licence="BSD-2-Clause",
        package="piqp",
        linear_solver="its own Cholesky (dense) or sparse LDLᵀ, once per iteration",
        phases="equilibration and symbolic analysis (preparing); all factorisations "
        "(solving)",
        sequence="`update` replaces vectors and keeps the analysis; no warm starts",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("backend", self.backend, ("auto", "dense", "sparse"))

    def declines(self, qp: QP) -> str | None:
        as_dense = resolve_backend(self.backend, qp) == "dense"
        return needs_dense(qp, 4) if as_dense else needs_matrices(qp)

    def library(self) -> Any:
        import piqp

        return piqp.SparseSolver().settings

    def _begin(self, qp: QP, tol: float) -> Session:
        import piqp

        is_dense = resolve_backend(self.backend, qp) == "dense"
        convert = (lambda M: np.asfortranarray(dense(M))) if is_dense else csc
        solver = piqp.DenseSolver() if is_dense else piqp.SparseSolver()
        s = solver.settings
        self.tune(
            s,
            eps_abs=NEGLIGIBLE,
            eps_duality_gap_abs=NEGLIGIBLE,
            eps_rel=tol,
            eps_duality_gap_rel=tol,
            check_duality_gap=True,
            compute_timings=True,
            max_iter=self.max_iter,
        )
        scale = objective_factor(qp)
        P, A, G = convert(qp.P) * scale, convert(qp.A), convert(qp.G)
        solver.setup(P, qp.q * scale, A, qp.b, G, None, qp.h, qp.lb, qp.ub)

        def solve() -> Solution:
            status = CLAIMS.get(solver.solve().name, Status.FAILED)
            r, info = solver.result, solver.result.info
            # the diverging multipliers approach a certificate of infeasibility
            return concluded(
                qp,
                status,
                info.status.name,
                dict(y=r.y / scale, z=r.z_u / scale, z_box=(r.z_bu - r.z_bl) / scale),
                x=r.x,
                iterations=info.iter,
                counts={"factor_retries": info.factor_retires},
                reported={
                    "linear_solver": s.kkt_solver.name,
                    "setup_seconds": info.setup_time,
                    "solve_seconds": info.solve_time,
                    "factor_seconds": info.kkt_factor_time,
                },
            )

        def update(new: QP) -> None:
            c, h = new.q * scale, new.h
            solver.update(c=c, b=new.b, h_u=h, x_l=new.lb, x_u=new.ub)

        return Session(solve, update)


DENSE = PIQP(backend="dense")
SPARSE = PIQP(backend="sparse")
