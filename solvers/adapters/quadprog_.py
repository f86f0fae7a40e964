"""quadprog, the dual active-set method of Goldfarb and Idnani.

Reference: D. Goldfarb, A. Idnani, A numerically stable dual method for solving strictly
convex quadratic programs, Math. Program. 27 (1983) 1-33.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.linalg import LinAlgError, cholesky, solve_triangular

from mortarbench.harness import QP, About, Solution, Status
from mortarbench.solvers.common.conversion import (
    dense,
    fixed_in_rows,
    needs_dense,
    needs_independent_rows,
    objective_factor,
    to_cone,
)

#: a Hessian counts as singular if the ratio of its smallest to its largest Cholesky
#: pivot is below this value
MIN_PIVOT = 1e-12


@dataclass(frozen=True)
class Quadprog:
    """https://github.com/quadprog/quadprog, with dense matrices.

    quadprog has no tolerance, so the adapter does not use `tol`. After finitely many
    changes of the active set, the KKT conditions hold up to rounding.

    The adapter factorises the Hessian of a QP. It declines the QP if the Hessian is not
    positive definite, or if the smallest Cholesky pivot is below 1e-12 times the
    largest pivot.
    """

    about: ClassVar[About] = About(
        title="quadprog",
        method="dual active set (Goldfarb-Idnani)",
        licence="GPL-2.0-or-later",
        package="quadprog",
        linear_solver="dense Cholesky (LAPACK), and an updated QR of the active rows",
        phases="factor of P and its inverse (preparing); iterations (solving)",
        limits=(
            "quadprog solves strictly convex QPs only. The form `dual` is declined if "
            "F is singular.",
            "Linearly dependent equality rows are declined, because quadprog claims "
            "infeasibility even if they are consistent (conformance, shape "
            "'redundant').",
        ),
    )

    def declines(self, qp: QP) -> str | None:
        return needs_dense(qp, 4) or needs_independent_rows(fixed_in_rows(qp)[0])

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        # with equal bounds as inequalities, quadprog claims that one of eight feasible
        # QPs (conformance, shape 'fixed') is infeasible
        other, back = fixed_in_rows(qp)
        solve = self._prepare(other)
        return lambda: back(solve())

    def _prepare(self, qp: QP) -> Callable[[], Solution]:
        import quadprog

        scale = objective_factor(qp, 1.0)
        try:
            L = cholesky(dense(qp.P) * scale, lower=True)
        except LinAlgError:
            return lambda: _declined(qp, "P is not positive definite")
        pivots = np.diag(L) ** 2
        if pivots.min() < MIN_PIVOT * pivots.max():
            return lambda: _declined(qp, "P is singular to working precision")
        inverse = solve_triangular(L, np.eye(len(L)), lower=True).T
        form = to_cone(qp)
        C, rhs = -form.rows.toarray().T, form.rhs
        a = -qp.q * scale

        def solve() -> Solution:
            constraints = (C, -rhs, qp.b.size) if rhs.size else (None, None, 0)
            try:
                x, _, _, iterations, v, _ = quadprog.solve_qp(
                    inverse, a, *constraints, factorized=True
                )
            except ValueError as e:
                infeasible = "inconsistent" in str(e)
                status = Status.INFEASIBLE if infeasible else Status.FAILED
                return Solution.without_point(qp, status, str(e))
            return Solution(
                status=Status.SOLVED,
                x=x,
                **form.multipliers(v[: rhs.size] / scale),
                iterations=int(iterations[0]),
                message="solved",
                counts={"dropped_rows": int(iterations[1])},
                reported={"linear_solver": "dense cholesky, updated qr"},
            )

        return solve


def _declined(qp: QP, reason: str) -> Solution:
    return Solution.without_point(qp, Status.DECLINED, reason)
