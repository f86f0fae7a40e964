"""QPALM, a proximal augmented Lagrangian method.

Reference: B. Hermans, A. Themelis, P. Patrinos, QPALM: a proximal augmented Lagrangian
method for nonconvex quadratic programs, Math. Program. Comput. 14 (2022) 497-541.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mortarbench.harness import (
    NO_SOLUTION,
    QP,
    About,
    Solution,
    Status,
    Vector,
)
from mortarbench.solvers.common.adapter import SequenceAdapter
from mortarbench.solvers.common.conversion import (
    NEGLIGIBLE,
    csc,
    from_two_sided,
    to_two_sided,
    two_sided,
)
from mortarbench.solvers.common.sequence import Session

CLAIMS = {
    "SOLVED": Status.SOLVED,
    "MAX_ITER_REACHED": Status.ITERATION_LIMIT,
    "TIME_LIMIT_REACHED": Status.TIME_LIMIT,
    "PRIMAL_INFEASIBLE": Status.INFEASIBLE,
    "DUAL_INFEASIBLE": Status.UNBOUNDED,
}  #: all other statuses count as FAILED
INFINITE = 1e20  #: QPALM's value for an absent bound


@dataclass(frozen=True)
class QPALM(SequenceAdapter):
    """https://kul-optec.github.io/QPALM.

    QPALM stops when the max norms of the primal and dual residuals are each below
    eps_abs + eps_rel·(their largest term). Therefore eps_rel = tol and eps_abs is
    negligible. Bounds become rows of the identity.
    """

    max_iter: int = 10_000

    about: ClassVar[About] = About(
        title="QPALM",
        method="proximal augmented Lagrangian with semismooth Newton steps",
        licence="LGPL-3.0-or-later",
        package="qpalm",
        linear_solver="LADEL (sparse LDLᵀ, updated when the active set changes)",
        phases="scaling (preparing); all factorisations (solving)",
        sequence="updates replace vectors; starts from the last point",
        limits=(
            "QPALM does not test the duality gap, so it may stop while the gap is "
            "large.",
        ),
    )

    def library(self) -> Any:
        import qpalm

        return qpalm.Settings()

    def _begin(self, qp: QP, tol: float) -> Session:
        import qpalm

        rows, low, high = _rows(qp)
        data = qpalm.Data(qp.q.size, low.size)
        data.Q, data.q, data.A = csc(qp.P), qp.q, rows
        data.bmin, data.bmax = low, high
        settings = qpalm.Settings()
        self.tune(
            settings, eps_abs=NEGLIGIBLE, eps_rel=tol, max_iter=self.max_iter, verbose=0
        )
        solver = qpalm.Solver(data, settings)
        claims = {getattr(qpalm.Info, name): CLAIMS[name] for name in CLAIMS}
        starts: list[tuple[Vector, Vector]] = []

        def solve() -> Solution:
            if starts:
                solver.warm_start(*starts.pop())
            solver.solve(asynchronous=False)
            info = solver.info
            status = claims.get(info.status_val, Status.FAILED)
            if status in NO_SOLUTION:
                ray: dict[str, Vector] = {}
                if status is Status.INFEASIBLE:
                    ray = from_two_sided(qp, np.array(solver.prim_inf_certificate))
                return Solution.without_point(qp, status, info.status, **ray)
            x, y = np.array(solver.solution.x), np.array(solver.solution.y)
            return Solution(
                status=status,
                x=x,
                **from_two_sided(qp, y),
                iterations=info.iter,
                message=info.status,
                counts={"outer": info.iter_out},
                reported={
                    "linear_solver": "ladel",
                    "setup_seconds": info.setup_time,
                    "solve_seconds": info.solve_time,
                },
            )

        def update(new: QP) -> None:
            _, low, high = _rows(new)
            solver.update_q(new.q)
            solver.update_bounds(low, high)
            if np.isfinite(solver.solution.x).all():
                starts.append(
                    (np.array(solver.solution.x), np.array(solver.solution.y))
                )

        def start(s: Solution) -> None:
            starts.append((s.x, to_two_sided(qp, s)))

        return Session(solve, update, start)


def _rows(qp: QP) -> tuple[object, Vector, Vector]:
    rows, low, high = two_sided(qp)
    return rows, np.maximum(low, -INFINITE), np.minimum(high, INFINITE)
