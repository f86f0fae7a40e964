"""Clarabel, an interior-point method for conic programs.

Reference: P. J. Goulart, Y. Chen, Clarabel: an interior-point solver for conic programs
with quadratic objectives, arXiv:2405.12762 (2024).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
from scipy.sparse import triu

from mortarbench.harness import (
    QP,
    About,
    Solution,
    Status,
)
from mortarbench.solvers.common.adapter import SequenceAdapter, concluded
from mortarbench.solvers.common.conversion import (
    CONIC_SETS,
    csc,
    objective_factor,
    to_cone,
)
from mortarbench.solvers.common.sequence import Session, chain

CLAIMS = {
    "Solved": Status.SOLVED,
    "MaxIterations": Status.ITERATION_LIMIT,
    "MaxTime": Status.TIME_LIMIT,
    "PrimalInfeasible": Status.INFEASIBLE,
    "DualInfeasible": Status.UNBOUNDED,
}  #: all other statuses (AlmostSolved, InsufficientProgress, …) count as FAILED


@dataclass(frozen=True)
class Clarabel(SequenceAdapter):
    """https://clarabel.org, with one thread.

    Clarabel divides each residual by max(1, size of its terms). The gap must be below
    tol, either in absolute terms or relative to max(1, |objective|). For a small
    objective, these tests are absolute: at an energy of 1e-5, tol = 1e-6 would lose
    five digits. The adapter scales the objective to ‖q‖∞ = 1e4 and passes tol
    unchanged. Each test is then relative if x is at least of order one. If the units
    make x tiny, Clarabel may stop early. The scaling hardly changes the steps, because
    Clarabel equilibrates the objective.

    Equalities are assigned to the zero cone; inequalities and finite bounds, one row
    each, to the nonnegative cone; discs and cones, to second-order cones.
    """

    max_iter: int = 200

    accepts: ClassVar[tuple[type, ...]] = CONIC_SETS
    about: ClassVar[About] = About(
        title="Clarabel",
        method="interior point (homogeneous embedding)",
        licence="Apache-2.0",
        package="clarabel",
        linear_solver="QDLDL or faer (sparse LDLᵀ), chosen by Clarabel; one "
        "factorisation per iteration",
        phases="equilibration and symbolic analysis (preparing); all factorisations "
        "(solving)",
        sequence="`update` replaces vectors and keeps the analysis; no warm starts",
    )

    def chain(self, tol: float) -> Callable[[QP], Callable[[], Solution]]:
        return chain(partial(self._begin, presolve=False), tol)

    def library(self) -> Any:
        import clarabel

        return clarabel.DefaultSettings()

    def _begin(self, qp: QP, tol: float, *, presolve: bool = True) -> Session:
        import clarabel

        form = to_cone(qp)
        cones = [
            clarabel.ZeroConeT(form.equalities),
            clarabel.NonnegativeConeT(form.inequalities),
            *map(clarabel.SecondOrderConeT, form.cones.tolist()),
        ]
        settings = clarabel.DefaultSettings()
        self.tune(
            settings,
            verbose=False,
            max_threads=1,
            max_iter=self.max_iter,
            tol_feas=tol,
            tol_gap_abs=tol,
            tol_gap_rel=tol,
            presolve_enable=presolve,  # presolved problems cannot be updated
        )
        scale = objective_factor(qp)
        P = csc(triu(csc(qp.P))) * scale
        solver = clarabel.DefaultSolver(
            P, qp.q * scale, form.rows, form.rhs, cones, settings
        )

        def solve() -> Solution:
            r = solver.solve()
            return concluded(
                qp,
                CLAIMS.get(str(r.status), Status.FAILED),
                str(r.status),
                form.multipliers(np.array(r.z) / scale),
                x=np.array(r.x),
                iterations=r.iterations,
                reported={
                    "linear_solver": solver.get_info().linsolver.name,
                    "solve_seconds": r.solve_time,
                },
            )

        def update(new: QP) -> None:
            solver.update(q=new.q * scale, b=to_cone(new).rhs)

        return Session(solve, update)
