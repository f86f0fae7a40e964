"""The reference solve that problem families are given; never a solver under test.

A positive definite QP with lower bounds only, min ½xᵀPx + qᵀx over x ≥ lb, is with the
Cholesky factor P = LLᵀ the nonnegative least-squares problem min ½‖Lᵀy + L⁻¹(q + P lb)‖
over y = x − lb ≥ 0. Lawson and Hanson's active-set method ends after finitely many
steps with the exact active set; the free components are then solved for once more,
directly, with one step of iterative refinement.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular
from scipy.optimize import nnls

from harness import QP, Solution, Status


def reference_solution(qp: QP) -> Solution:
    """Solve  min ½xᵀPx + qᵀx, x ≥ lb  to rounding.

    Raises
    ------
    ValueError
        For a QP of another shape: rows, an upper bound, or a free variable.
    numpy.linalg.LinAlgError
        When P is not positive definite.

    """
    if qp.b.size or qp.h.size or np.isfinite(qp.ub).any() or np.isinf(qp.lb).any():
        raise ValueError(
            "the reference solve takes lower bounds only, on all variables"
        )
    P = qp.P if isinstance(qp.P, np.ndarray) else qp.P.toarray()
    gradient_at_lb = qp.q + P @ qp.lb
    L = cholesky(P, lower=True)
    y, _ = nnls(L.T, -solve_triangular(L, gradient_at_lb, lower=True))

    free = y > 0
    y[free] = 0
    if free.any():
        factor = cho_factor(P[np.ix_(free, free)])
        for _ in range(2):
            y[free] -= cho_solve(factor, (P @ y + gradient_at_lb)[free])
    gradient = P @ y + gradient_at_lb
    return Solution(
        status=Status.SOLVED, x=qp.lb + np.maximum(y, 0), y=np.zeros(0), z=np.zeros(0),
        z_box=np.where(free, 0.0, -gradient),
    )  # fmt: skip
