"""DAQP, a dual active-set method.

Reference: D. Arnström, A. Bemporad, D. Axehill, A dual active-set solver for embedded
quadratic programming using recursive LDLᵀ updates, IEEE Trans. Automat. Control 67
(2022) 4362-4369.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mortarbench.harness import NO_SOLUTION, QP, About, Solution, Status, Vector
from mortarbench.solvers.common.adapter import SequenceAdapter
from mortarbench.solvers.common.conversion import (
    dense,
    needs_dense,
    objective_factor,
)
from mortarbench.solvers.common.sequence import Session

#: claim and message of each exit flag
CLAIMS = {
    1: (Status.SOLVED, "optimal"),
    2: (Status.FAILED, "soft optimal"),  # solves a QP with softened constraints
    -1: (Status.INFEASIBLE, "infeasible"),
    -2: (Status.FAILED, "cycling"),
    -3: (Status.UNBOUNDED, "unbounded"),
    -4: (Status.ITERATION_LIMIT, "iteration limit"),
    -5: (Status.FAILED, "nonconvex"),
    -6: (Status.FAILED, "overdetermined initial working set"),
    -7: (Status.TIME_LIMIT, "time limit"),
}
INFINITE = 1e30  #: DAQP's value for an absent bound
EQUALITY = 5  #: DAQP's flag for an equality
TOL_FACTOR = 1e-3  #: tolerances passed to DAQP, relative to tol
#: smallest tolerance passed to DAQP; with 1e-12, DAQP's proximal iterations stop early
#: or cycle
MIN_TOLERANCE = 1e-11


@dataclass(frozen=True)
class DAQP(SequenceAdapter):
    """https://darnstrom.github.io/daqp, with dense matrices.

    At the final active set of DAQP, the KKT conditions hold up to rounding. The options
    primal_tol and dual_tol only set the size of violations and negative multipliers
    that DAQP ignores. Both tolerances are absolute. Therefore the objective is scaled
    to ‖q‖∞ = 1, and both are set to tol/1000, but at least 1e-11. Larger values would
    not save steps.

    If the Cholesky factorisation of P breaks down, DAQP runs proximal-point iterations
    (eps_prox < 0 selects them automatically).
    """

    max_iter: int = 100_000

    about: ClassVar[About] = About(
        title="DAQP",
        method="dual active set",
        licence="MIT",
        package="daqp",
        linear_solver="its own dense LDLᵀ, updated when the active set changes",
        phases="conversion to dense matrices and factorisation (preparing); iterations "
        "(solving)",
        sequence="`update` replaces vectors and keeps the factors and the active set",
        limits=(
            "DAQP takes more than 20 s on the 4420 unknowns of "
            "beam-ring/Nr=12/Nh=6/primal (suites/fleet.toml).",
            "With tolerances of 1e-12, the proximal iterations of DAQP end with "
            "residuals of 7e-7 on singular QPs.",
        ),
    )

    def declines(self, qp: QP) -> str | None:
        return needs_dense(qp, 3)

    def library(self) -> Any:
        import daqp

        return daqp.Model().settings

    def _begin(self, qp: QP, tol: float) -> Session:
        import daqp

        n, m = qp.q.size, qp.b.size
        scale = objective_factor(qp, 1.0)
        H, A = dense(qp.P) * scale, np.vstack([dense(qp.A), dense(qp.G)])
        low, high = _sides(qp)
        sense = np.zeros(high.size, dtype=np.int32)
        sense[n : n + m] = EQUALITY
        eps = max(tol * TOL_FACTOR, MIN_TOLERANCE)
        model = daqp.Model()
        model.settings = self.tuned(
            primal_tol=eps, dual_tol=eps, iter_limit=self.max_iter, eps_prox=-1.0
        )
        _, setup_seconds = model.setup(H, qp.q * scale, A, high, low, sense)

        def solve() -> Solution:
            x, _, flag, info = model.solve()
            status, message = CLAIMS.get(flag, (Status.FAILED, f"exit flag {flag}"))
            if status in NO_SOLUTION:
                return Solution.without_point(qp, status, message)
            lam: Vector = np.array(info["lam"]) / scale
            return Solution(
                status=status,
                x=np.array(x),
                y=lam[n : n + m],
                z=lam[n + m :],
                z_box=lam[:n],
                iterations=info["iterations"],
                message=message,
                counts={"outer": info["nodes"]},
                reported={
                    "linear_solver": "dense ldl, updated",
                    "setup_seconds": setup_seconds,
                    "solve_seconds": info["solve_time"],
                },
            )

        def update(new: QP) -> None:
            low, high = _sides(new)
            model.update(f=new.q * scale, bupper=high, blower=low)

        return Session(solve, update)


def _sides(qp: QP) -> tuple[Vector, Vector]:
    """Return lower and upper limits of the variables, equality and inequality rows."""
    no_low = np.full(qp.h.size, -INFINITE)
    low = np.concatenate([np.maximum(qp.lb, -INFINITE), qp.b, no_low])
    return low, np.concatenate([np.minimum(qp.ub, INFINITE), qp.b, qp.h])
