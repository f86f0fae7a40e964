"""Every backend of cvxpy, through its modelling language.

Reference: S. Diamond, S. Boyd, CVXPY: a Python-embedded modeling language for convex
optimization, J. Mach. Learn. Res. 17(83) (2016) 1-5.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harness import QP, Solution, Status
from solvers.backends import adapter_files, why_not
from solvers.conversion import NEGLIGIBLE, csc, needs_matrices

#: backend → keywords that get tol, and keywords with a fixed value
KEYWORDS: Mapping[str, tuple[tuple[str, ...], Mapping[str, Any]]] = {
    "CLARABEL": (("tol_feas", "tol_gap_abs", "tol_gap_rel"), {"max_threads": 1}),
    "HIGHS": (
        ("primal_feasibility_tolerance", "dual_feasibility_tolerance"),
        # HiGHS else adds 1e-7 to the Hessian and drops entries below 1e-9
        {"qp_regularization_value": 0.0, "small_matrix_value": 1e-12, "threads": 1},
    ),
    "OSQP": (
        ("eps_rel",),
        {"eps_abs": NEGLIGIBLE, "max_iter": 1_000_000, "polishing": False},
    ),
    "PROXQP": (("eps_rel",), {"eps_abs": NEGLIGIBLE}),
    "SCS": (("eps_rel",), {"eps_abs": NEGLIGIBLE, "max_iters": 1_000_000}),
}

CLAIMS = {
    "optimal": Status.SOLVED,
    "user_limit": Status.ITERATION_LIMIT,
    "infeasible": Status.INFEASIBLE,
    "unbounded": Status.INFEASIBLE,
    "infeasible_or_unbounded": Status.INFEASIBLE,
}  #: anything else (optimal_inaccurate, …) is FAILED


@dataclass(frozen=True)
class CVXPY:
    """One backend of cvxpy; compilation is preparing, the backend's setup solving.

    The tolerance goes to the backend's own keywords (`KEYWORDS`), the relative one
    where there are two; a backend that is not listed there runs at cvxpy's defaults.
    Where the backend's test is absolute (CLARABEL, HIGHS, …) so is the accuracy: the QP
    is handed over as it is. cvxpy cannot switch ProxQP's test of the gap on.
    """

    backend: str = ""  #: the NAME in cvxpy:NAME

    @staticmethod
    def backends() -> tuple[str, ...]:
        """List the names that the installed cvxpy knows, installed or not."""
        return tuple(_files())

    def declines(self, qp: QP) -> str | None:
        return why_not("cvxpy", self.backend, _files()) or needs_matrices(qp)

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        import cvxpy

        problem, x, constraints = _model(cvxpy, qp)
        tolerances, fixed = KEYWORDS.get(self.backend, ((), {}))
        options = {**dict.fromkeys(tolerances, tol), **fixed}
        data, chain, inverse = problem.get_problem_data(
            self.backend, solver_opts=dict(options)
        )

        def solve() -> Solution:
            with warnings.catch_warnings():  # they repeat the status
                warnings.simplefilter("ignore")
                try:
                    raw = chain.solve_via_data(
                        problem, data, warm_start=False, solver_opts=dict(options)
                    )
                    problem.unpack_results(raw, chain, inverse)
                except cvxpy.SolverError as e:
                    return Solution.without_point(qp, Status.FAILED, str(e))
            status = CLAIMS.get(problem.status, Status.FAILED)
            if status is Status.INFEASIBLE or x.value is None:
                return Solution.without_point(qp, status, problem.status)
            return _solution(qp, status, problem, x, constraints)

        return solve


def _files() -> dict[str, Path]:
    folder = "reductions/solvers"
    conic = adapter_files("cvxpy", f"{folder}/conic_solvers/*_conif.py", "_conif.py")
    quadratic = adapter_files("cvxpy", f"{folder}/qp_solvers/*_qpif.py", "_qpif.py")
    return {name.upper(): path for name, path in sorted({**conic, **quadratic}.items())}


def _model(cvxpy: Any, qp: QP) -> tuple[Any, Any, dict[str, Any]]:
    """State `qp` in cvxpy with constant data, each block of constraints by name."""
    x = cvxpy.Variable(qp.q.size)
    low, up = np.isfinite(qp.lb), np.isfinite(qp.ub)
    constraints = {}
    if qp.b.size:
        constraints["y"] = csc(qp.A) @ x == qp.b
    if qp.h.size:
        constraints["z"] = csc(qp.G) @ x <= qp.h
    if low.any():
        constraints["low"] = x[np.flatnonzero(low)] >= qp.lb[low]
    if up.any():
        constraints["up"] = x[np.flatnonzero(up)] <= qp.ub[up]
    # assume_PSD: no eigenvalues are computed to prove convexity
    energy = cvxpy.quad_form(x, csc(qp.P), assume_PSD=True)
    objective = cvxpy.Minimize(0.5 * energy + qp.q @ x)
    return cvxpy.Problem(objective, list(constraints.values())), x, constraints


def _solution(
    qp: QP, status: Status, problem: Any, x: Any, constraints: Mapping[str, Any]
) -> Solution:
    sizes = {"y": qp.b.size, "z": qp.h.size, "low": 0, "up": 0}
    y, z, low, up = (
        np.ravel(constraints[name].dual_value) if name in constraints else np.zeros(k)
        for name, k in sizes.items()
    )
    z_box = np.zeros(qp.q.size)
    z_box[np.isfinite(qp.ub)] += up
    z_box[np.isfinite(qp.lb)] -= low
    return Solution(
        status=status,
        x=np.ravel(x.value), y=y, z=z, z_box=z_box,
        iterations=problem.solver_stats.num_iters, message=problem.status,
    )  # fmt: skip
