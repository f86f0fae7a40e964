"""The backends of cvxpy, called through its modelling language.

Reference: S. Diamond, S. Boyd, CVXPY: a Python-embedded modeling language for convex
optimization, J. Mach. Learn. Res. 17(83) (2016) 1-5.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import (
    NO_SOLUTION,
    QP,
    About,
    Box,
    Solution,
    Status,
    needs_matrices,
)
from mortarbench.solvers.common.backends import (
    BackendAdapter,
    adapter_files,
    call_of,
    reason_unavailable,
)
from mortarbench.solvers.common.conversion import (
    CONIC_SETS,
    DIVERGED,
    ConicForm,
    csc,
    objective_factor,
    to_cone,
)

SECOND_ORDER = ("CLARABEL", "QOCO", "SCS")  #: backends that accept discs and cones
CONIC = "cvxpy passes QPs to it as cone programs, which costs half of the digits"
LINEAR = "solves linear programs only"
DECLINED_BACKENDS: Mapping[str, str] = {
    "CVXOPT": CONIC,
    "ECOS": CONIC,
    "ECOS_BB": CONIC,
    "GLPK": LINEAR,
    "GLPK_MI": LINEAR,
    "SCIPY": LINEAR,
    "PROXQP": "cvxpy cannot enable its test of the duality gap; use the solver proxqp",
}

CLAIMS = {
    "optimal": Status.SOLVED,
    "user_limit": Status.ITERATION_LIMIT,
    "infeasible": Status.INFEASIBLE,
    "unbounded": Status.UNBOUNDED,
    "infeasible_or_unbounded": Status.INFEASIBLE,
}  #: all other statuses (optimal_inaccurate, …) count as FAILED


@dataclass(frozen=True)
class CVXPY(BackendAdapter):
    """One backend of cvxpy.

    The tolerance is passed in the backend's own keywords (`solvers.common.backends`).
    If the threshold of a stopping test is the sum of an absolute and a relative term,
    `tol` is the relative tolerance and the absolute tolerance is negligible. A backend
    that is not listed there runs with cvxpy's defaults. The objective is scaled to ‖q‖∞
    = 1e4, or to ‖q‖∞ = 1 if the backend's test is absolute (HIGHS, DAQP). The adapter
    declines all QPs for CVXOPT and ECOS, which would receive them as cone programs, for
    backends that solve linear programs only, and for ProxQP, because cvxpy cannot
    enable ProxQP's test of the duality gap.
    """

    about: ClassVar[About] = About(
        title="cvxpy",
        method="method of the backend NAME",
        licence="Apache-2.0; backends have their own licences",
        package="cvxpy",
        linear_solver="linear solver of the backend",
        phases="compilation of the model to the backend's data (preparing); setup and "
        "solve of the backend (solving)",
        limits=(
            "QPs are declined for CVXOPT and ECOS: as cone programs, they lose half "
            "of the digits (dual residuals of 1e-5 at tol 1e-6 in the conformance "
            "suite).",
            "QPs are declined for PROXQP: without the test of the duality gap, the "
            "complementarity of a claimed solution is 2e-6 at tol 1e-9 (conformance, "
            "shape 'bounds').",
        ),
    )

    @property
    def accepts(self) -> tuple[type, ...]:
        """Convex sets that the backend accepts."""
        return CONIC_SETS if self.backend in SECOND_ORDER else (Box,)

    @staticmethod
    def backends() -> tuple[str, ...]:
        """Return the names of all backends of cvxpy, installed or not."""
        return tuple(_files())

    def declines(self, qp: QP) -> str | None:
        if reason := reason_unavailable("cvxpy", self.backend, _files()):
            return reason
        has_rows = len(qp.sets) > 1 or sum(qp.sizes.values()) > qp.q.size
        if self.backend == "SCS" and not has_rows:
            return "needs a row or a bound"
        return DECLINED_BACKENDS.get(self.backend) or needs_matrices(qp)

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        import cvxpy

        call, form = call_of(self.backend), to_cone(qp)
        options = self.tuned(**call.options(tol))
        scale = objective_factor(qp, call.size)
        problem, x, constraints = _model(cvxpy, qp, form, scale)
        data, chain, inverse = problem.get_problem_data(
            self.backend, solver_opts=dict(options)
        )

        def solve() -> Solution:
            with warnings.catch_warnings():  # cvxpy's warnings only repeat the status
                warnings.simplefilter("ignore")
                try:
                    raw = chain.solve_via_data(
                        problem, data, warm_start=False, solver_opts=dict(options)
                    )
                    problem.unpack_results(raw, chain, inverse)
                except cvxpy.SolverError as e:
                    return Solution.without_point(qp, Status.FAILED, str(e))
            status = CLAIMS.get(problem.status, Status.FAILED)
            if status in NO_SOLUTION or x.value is None:
                return Solution.without_point(qp, status, problem.status)
            if status is Status.SOLVED and np.abs(x.value).max() > DIVERGED:
                return Solution.without_point(qp, Status.FAILED, "diverged")
            return _solution(form, status, problem, x, constraints, scale)

        return solve


def _files() -> dict[str, Path]:
    folder = "reductions/solvers"
    conic = adapter_files("cvxpy", f"{folder}/conic_solvers/*_conif.py", "_conif.py")
    quadratic = adapter_files("cvxpy", f"{folder}/qp_solvers/*_qpif.py", "_qpif.py")
    return {name.upper(): path for name, path in sorted({**conic, **quadratic}.items())}


def _model(
    cvxpy: Any, qp: QP, form: ConicForm, scale: float
) -> tuple[Any, Any, list[tuple[NDArray[np.int64], Any]]]:
    """Return the problem, its variable, and the constraints with their row indices."""
    x, rows = cvxpy.Variable(qp.q.size), form.rows.tocsr()
    # without assume_PSD, cvxpy computes eigenvalues of P to check convexity
    energy = cvxpy.quad_form(x, csc(qp.P) * scale, assume_PSD=True)
    objective = cvxpy.Minimize(0.5 * energy + (qp.q * scale) @ x)
    equal, less = np.split(np.arange(form.linear), [form.equalities])
    constraints = []
    if equal.size:
        constraints.append((equal, rows[equal] @ x == form.rhs[equal]))
    if less.size:
        constraints.append((less, rows[less] @ x <= form.rhs[less]))
    for size in np.unique(form.cones):  # one constraint for all cones of a size
        heads = form.heads[form.cones == size]
        tails = (heads[:, None] + np.arange(1, size)).ravel()
        t, w = (form.rhs[place] - rows[place] @ x for place in (heads, tails))
        W = cvxpy.reshape(w, (heads.size, size - 1), order="C")
        constraints.append((np.append(heads, tails), cvxpy.SOC(t, W, axis=1)))
    return cvxpy.Problem(objective, [one for _, one in constraints]), x, constraints


def _solution(
    form: ConicForm,
    status: Status,
    problem: Any,
    x: Any,
    constraints: Sequence[tuple[NDArray[np.int64], Any]],
    scale: float,
) -> Solution:
    v = np.zeros(form.rhs.size)
    for place, constraint in constraints:
        dual = constraint.dual_value
        parts = dual if isinstance(dual, list) else [dual]
        v[place] = np.concatenate([np.ravel(part) for part in parts]) / scale
    return Solution(
        status=status,
        x=np.ravel(x.value),
        **form.multipliers(v),
        iterations=problem.solver_stats.num_iters,
        message=problem.status,
    )
