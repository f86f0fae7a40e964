"""Every backend of qpsolvers, called through its unified interface.

Reference: S. Caron et al., qpsolvers: quadratic programming solvers in Python,
https://github.com/qpsolvers/qpsolvers.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from mortarbench.harness import (
    NO_SOLUTION,
    QP,
    About,
    Matrix,
    Solution,
    Status,
    Vector,
    needs_matrices,
)
from mortarbench.solvers.common.backends import (
    BackendAdapter,
    adapter_files,
    call_of,
    reason_unavailable,
)
from mortarbench.solvers.common.conversion import (
    csc,
    dense,
    needs_dense,
    objective_factor,
    on_present_bounds,
)

#: backends that accept dense matrices only
DENSE_BACKENDS = ("hpipm", "jaxopt_osqp", "pyqpmad", "qpax", "qpoases", "quadprog")
#: backends that do not receive unconstrained QPs, because qpsolvers solves these QPs
#: itself, with a wrong result
NEEDS_CONSTRAINT = ("clarabel", "qtqp", "scs")
NEEDS_INDEPENDENT_ROWS = ("cvxopt", "quadprog")
#: claim for a status message without a solution; the first pattern that matches counts
STATUS_PATTERNS = (
    (r"max(imum)?_?\W*iter", Status.ITERATION_LIMIT),
    (r"time", Status.TIME_LIMIT),
    (r"almost|inaccurate", Status.FAILED),
    (r"unbounded|dual.?infeasible", Status.UNBOUNDED),
    (r"infeasible", Status.INFEASIBLE),
)


@dataclass(frozen=True)
class QPSolvers(BackendAdapter):
    """One backend of qpsolvers.

    The tolerance is passed in the backend's own keywords (`solvers.common.backends`).
    If the threshold of a stopping test is the sum of an absolute and a relative term,
    `tol` is the relative tolerance and the absolute tolerance is negligible. A backend
    that is not listed there runs with its own defaults. The objective is scaled to ‖q‖∞
    = 1e4, or to ‖q‖∞ = 1 if the backend's test is absolute (highs, daqp). Backends that
    accept both dense and sparse matrices receive dense matrices if P is dense.
    """

    about: ClassVar[About] = About(
        title="qpsolvers",
        method="method of the backend NAME",
        licence="LGPL-3.0-or-later; backends have their own licences",
        package="qpsolvers",
        linear_solver="linear solver of the backend",
        phases="conversion only (preparing); the backend's setup, factorisation and "
        "iterations (solving)",
        limits=(
            "Unconstrained QPs are declined for clarabel, qtqp and scs. qpsolvers "
            "would solve these QPs with its own code, which claims that strictly "
            "convex QPs are unbounded (conformance, shape 'unconstrained').",
            "qpsolvers reports no iterations for clarabel, cvxopt, daqp, highs, "
            "quadprog and sip.",
            "quadprog has no tolerance and solves strictly convex QPs only. QPs with "
            "equal bounds are declined, because it claims for one of eight of them "
            "(conformance, shape 'fixed') that no point is feasible.",
            "The backend ecos attains only half of the requested digits. pyqpmad, "
            "which `make setup` does not install, returns wrong multipliers for fixed "
            "variables.",
        ),
    )

    @staticmethod
    def backends() -> tuple[str, ...]:
        """Return the names of all backends of qpsolvers, installed or not."""
        return tuple(_files())

    def declines(self, qp: QP) -> str | None:
        if reason := reason_unavailable("qpsolvers", self.backend, _files()):
            return reason
        rows_and_bounds = sum(qp.sizes.values()) - qp.q.size
        if not rows_and_bounds and self.backend in NEEDS_CONSTRAINT:
            return "needs a row or a bound; qpsolvers solves unconstrained QPs itself"
        if self.backend == "qtqp" and rows_and_bounds == qp.b.size:
            return "needs an inequality row or a bound"
        if self.backend == "quadprog" and (qp.lb == qp.ub).any():
            return "takes feasible QPs with equal bounds for infeasible"
        needs_rank = self.backend in NEEDS_INDEPENDENT_ROWS
        if needs_rank and (reason := _needs_independent_rows(qp)):
            return reason
        dense_only = self.backend in DENSE_BACKENDS
        return needs_dense(qp, 4) if dense_only else needs_matrices(qp)

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        import qpsolvers

        call = call_of(self.backend)
        options = self.tuned(**call.options(tol))
        if self.backend == "osqp":
            options.setdefault("raise_error", False)
        scale = objective_factor(qp, call.size)
        takes_dense = self.backend in qpsolvers.dense_solvers
        as_dense = takes_dense and isinstance(qp.P, np.ndarray)
        convert = dense if as_dense or self.backend in DENSE_BACKENDS else csc
        problem = qpsolvers.Problem(**_arguments(qp, convert, scale))
        if self.backend == "sip":  # sip rejects P if rounding makes it asymmetric
            problem.P = csc((problem.P + problem.P.T) / 2)
        if self.backend == "highs" and not qp.b.size + qp.h.size:
            # without rows, HiGHS claims an optimum after 0 iterations
            problem.G, problem.h = convert(np.eye(1, qp.q.size)), np.array([np.inf])

        def solve() -> Solution:
            # qpsolvers' warnings only repeat the status
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    result = qpsolvers.solve_problem(problem, self.backend, **options)
                except qpsolvers.exceptions.QPError as e:
                    definite = "not positive definite" in str(e)
                    status = Status.DECLINED if definite else Status.FAILED
                    return Solution.without_point(qp, status, str(e))
            return _solution(qp, result, scale)

        return solve


def _files() -> dict[str, Path]:
    return adapter_files("qpsolvers", "solvers/[a-z]*_.py", "_.py")


def _arguments(
    qp: QP, convert: Callable[[Matrix], Matrix], scale: float
) -> dict[str, Any]:
    """Return the arguments of qpsolvers.Problem; absent rows and bounds are omitted."""
    arguments = {"P": convert(qp.P) * scale, "q": qp.q * scale}
    if qp.h.size:
        arguments |= {"G": convert(qp.G), "h": qp.h.copy()}
    if qp.b.size:
        arguments |= {"A": convert(qp.A), "b": qp.b.copy()}
    for name, bound in (("lb", qp.lb), ("ub", qp.ub)):
        if np.isfinite(bound).any():
            arguments[name] = bound.copy()
    return arguments


def _solution(qp: QP, result: Any, scale: float) -> Solution:
    """Convert a qpsolvers.Solution, which has the sign convention of `Solution`."""
    info = result.extras.get("info", result.extras)
    info = info if isinstance(info, Mapping) else _attributes(info)
    message = str(info.get("status", "found" if result.found else "not found"))
    status = Status.SOLVED if result.found else _claim(message)
    if status in NO_SOLUTION:
        return Solution.without_point(qp, status, message)
    z_box = _vector(result.z_box, qp.q.size, absent=not qp.sizes["bounds"])
    return Solution(
        status=status,
        x=_vector(result.x, qp.q.size),
        y=_vector(result.y, qp.b.size, absent=not qp.b.size) / scale,
        z=_vector(result.z, qp.h.size, absent=not qp.h.size) / scale,
        z_box=on_present_bounds(qp, z_box) / scale,
        iterations=info.get("iter"),
        message=message,
        reported={"linear_solver": name}
        if (name := info.get("lin_sys_solver"))
        else {},
    )


def _attributes(info: object) -> dict[str, Any]:
    names = ("iter", "status")
    return {name: getattr(info, name) for name in names if hasattr(info, name)}


def _claim(message: str) -> Status:
    matches = (s for w, s in STATUS_PATTERNS if re.search(w, message, re.IGNORECASE))
    return next(matches, Status.FAILED)


def _vector(v: Any, size: int, *, absent: bool = False) -> Vector:
    """Return `v` as a vector; zeros if `absent`, NaN if the size of `v` is wrong."""
    if absent:
        return np.zeros(size)
    if v is None or np.size(v) != size:
        return np.full(size, np.nan)
    return np.asarray(v, dtype=np.float64).ravel()


def _needs_independent_rows(qp: QP) -> str | None:
    """Return a reason to decline `qp` if its equality rows are dependent, or None."""
    # The eigenvalues of AAᵀ are the squared singular values of A. Therefore rows count
    # as dependent if the ratio of the smallest to the largest singular value of A is
    # below about √(mε) for m rows and the machine precision ε.
    gram = dense(csc(qp.A) @ csc(qp.A).T)
    if not gram.size or np.linalg.matrix_rank(gram, hermitian=True) == len(gram):
        return None
    return "the equality rows are linearly dependent"
