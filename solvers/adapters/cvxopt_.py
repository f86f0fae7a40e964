"""CVXOPT's coneqp, a path-following method.

Reference: L. Vandenberghe, The CVXOPT linear and quadratic cone program solvers,
https://www.cvxopt.org/documentation (2010).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mortarbench.harness import QP, About, Matrix, Solution, Status, needs_matrices
from mortarbench.solvers.common.conversion import (
    CONIC_SETS,
    check_positive,
    csc,
    dense,
    needs_independent_rows,
    objective_factor,
    to_cone,
)


@dataclass(frozen=True)
class CVXOPT:
    """https://cvxopt.org, with dense matrices if P is dense, otherwise sparse matrices.

    CVXOPT divides the 2-norm of the dual residual by max(1, ‖q‖), and the 2-norm of the
    primal residual by max(1, norm of the right-hand sides). The gap must be below
    abstol, or below reltol relative to the objective. Therefore feastol = reltol = tol
    and abstol is negligible. The objective is scaled to ‖q‖∞ = 1e4, so that the 1 in
    max(1, ‖q‖) has no effect.
    """

    max_iter: int = 200

    accepts: ClassVar[tuple[type, ...]] = CONIC_SETS
    about: ClassVar[About] = About(
        title="CVXOPT",
        method="interior point (path following)",
        licence="GPL-3.0-or-later",
        package="cvxopt",
        linear_solver="CHOLMOD (sparse) or LAPACK (dense), bundled, one factorisation "
        "per iteration",
        phases="conversion only (preparing); everything else (solving)",
        limits=(
            "Linearly dependent equality rows are declined, because CVXOPT ends with "
            "an error or the status 'unknown' (conformance, shape 'redundant').",
            "If only equality rows support the bodies, P is exactly singular. The "
            "default KKT solver, 'chol2', then ends with 'unknown' after 2 "
            "iterations; 'chol' and 'ldl' solve the same QP (docs/weaknesses.md).",
        ),
    )

    def __post_init__(self) -> None:
        check_positive(max_iter=self.max_iter)

    def declines(self, qp: QP) -> str | None:
        return needs_matrices(qp) or needs_independent_rows(qp)

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        import cvxopt
        from cvxopt import solvers

        is_dense = isinstance(qp.P, np.ndarray)
        form, scale = to_cone(qp), objective_factor(qp)
        rows, rhs, m = form.rows, form.rhs, form.equalities
        dims = dict(l=form.inequalities, q=form.cones.tolist(), s=[])
        blocks = [
            _matrix(cvxopt, M, is_dense) for M in (qp.P * scale, rows[m:], rows[:m])
        ]
        q, h, b = map(cvxopt.matrix, (qp.q * scale, rhs[m:].copy(), rhs[:m].copy()))
        options = dict(
            feastol=tol,
            reltol=tol,
            abstol=1e-300,
            maxiters=self.max_iter,
            show_progress=False,
        )

        def solve() -> Solution:
            P, G, A = blocks
            try:
                r = solvers.coneqp(P, q, G, h, dims, A, b, options=options)
            except (ValueError, ArithmeticError) as e:  # breakdown of a factorisation
                return Solution.without_point(qp, Status.FAILED, str(e))
            v = np.concatenate([np.ravel(r["y"]), np.ravel(r["z"])]) / scale
            done = r["iterations"] >= self.max_iter
            failed = Status.ITERATION_LIMIT if done else Status.FAILED
            return Solution(
                status=Status.SOLVED if r["status"] == "optimal" else failed,
                x=np.ravel(r["x"]),
                **form.multipliers(v),
                iterations=r["iterations"],
                message=r["status"],
                reported={"linear_solver": "lapack" if is_dense else "cholmod"},
            )

        return solve


def _matrix(cvxopt: Any, M: Matrix, is_dense: bool) -> Any:
    if is_dense:
        return cvxopt.matrix(dense(M))
    coo = csc(M).tocoo()
    return cvxopt.spmatrix(
        coo.data, coo.row.astype(int), coo.col.astype(int), coo.shape
    )
