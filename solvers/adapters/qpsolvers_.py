"""Every backend of qpsolvers, through its unified interface.

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
    QP,
    About,
    Matrix,
    Solution,
    Status,
    Vector,
    needs_matrices,
)
from mortarbench.solvers.common.backends import Call, adapter_files, reason_unavailable
from mortarbench.solvers.common.conversion import (
    NEGLIGIBLE,
    csc,
    dense,
    needs_dense,
    needs_independent_rows,
    objective_factor,
    on_present_bounds,
)

#: backend → how it is called; one that is not listed runs at its defaults
CALLS: Mapping[str, Call] = {
    "clarabel": Call(("tol_feas", "tol_gap_abs", "tol_gap_rel"), {"max_threads": 1}),
    "cvxopt": Call(("feastol", "abstol", "reltol")),
    "daqp": Call(("primal_tol", "dual_tol"), size=1.0, tighter=1e-3, floor=1e-11),
    "highs": Call(
        ("primal_feasibility_tolerance", "dual_feasibility_tolerance"),
        # HiGHS else adds 1e-7 to the Hessian and drops entries below 1e-9
        {
            "qp_regularization_value": 0.0, "small_matrix_value": 1e-12, "threads": 1,
            "qp_iteration_limit": 1_000_000,  # or it cycles for ever
        },
        size=1.0, tighter=1e-2, floor=1e-10,
    ),
    "osqp": Call(
        ("eps_rel",),
        {"eps_abs": NEGLIGIBLE, "max_iter": 1_000_000, "raise_error": False},
    ),
    "piqp": Call(
        ("eps_rel", "eps_duality_gap_rel"),
        {"eps_abs": NEGLIGIBLE, "eps_duality_gap_abs": NEGLIGIBLE},
    ),
    "proxqp": Call(
        ("eps_rel", "eps_duality_gap_rel"),
        {
            "eps_abs": NEGLIGIBLE,
            "eps_duality_gap_abs": NEGLIGIBLE,
            "check_duality_gap": True,
        },
    ),
    "qpalm": Call(("eps_rel",), {"eps_abs": NEGLIGIBLE}),
    "qtqp": Call(("tol_feas", "tol_gap_abs", "tol_gap_rel")),
    "scs": Call(("eps_rel",), {"eps_abs": NEGLIGIBLE, "max_iters": 1_000_000}),
    "sip": Call(("eps_rel",), {"eps_abs": NEGLIGIBLE}),
}  # fmt: skip

#: backends that take dense matrices only
DENSE_ONLY = ("hpipm", "jaxopt_osqp", "pyqpmad", "qpax", "qpoases", "quadprog")
#: backends for which qpsolvers treats QPs without any constraint itself, wrongly
NEEDS_CONSTRAINT = ("clarabel", "qtqp", "scs")
NEEDS_INDEPENDENT_ROWS = ("cvxopt", "quadprog")

#: what the words of an unsuccessful status mean, the first that matches
WORDS = (
    (r"max(imum)?_?\W*iter", Status.ITERATION_LIMIT),
    (r"time", Status.TIME_LIMIT),
    (r"almost|inaccurate", Status.FAILED),
    (r"infeasible|unbounded", Status.INFEASIBLE),
)


@dataclass(frozen=True)
class QPSolvers:
    """One backend of qpsolvers; everything but the conversion is timed as solving.

    The tolerance goes to the backend's own keywords (`CALLS`), the relative one where
    there are two; a backend that is not listed there runs at its defaults. As in the
    native adapters the objective is multiplied until ‖q‖∞ = 1e4, or 1 where the
    backend's test is absolute (highs, daqp). Backends that take both get dense matrices
    where P is dense. qpsolvers tells the iterations of some backends only.
    """

    backend: str = ""  #: the NAME in qpsolvers:NAME

    about: ClassVar[About] = About(
        title="qpsolvers",
        method="that of the backend NAME",
        licence="LGPL-3.0-or-later; each backend its own",
        package="qpsolvers",
        linear_solver="the backend's",
        phases="preparing converts only; setup and factorisation of every backend are "
        "solving",
        limits=(
            "qpsolvers treats QPs without any constraint itself for clarabel, qtqp and "
            "scs, and calls a strictly convex one unbounded (conformance, shape "
            "'unconstrained'); they are declined.",
            "No iterations from clarabel, cvxopt, daqp, highs, quadprog and sip.",
            "ecos reaches half of the digits (dual residuals of 1e-5 at tol 1e-9, by "
            "the conformance suite) and pyqpmad gives wrong multipliers for fixed "
            "variables (dual residual 0.35); neither is installed.",
        ),
    )

    @staticmethod
    def backends() -> tuple[str, ...]:
        """List the names that the installed qpsolvers knows, installed or not."""
        return tuple(_files())

    def declines(self, qp: QP) -> str | None:
        if reason := reason_unavailable("qpsolvers", self.backend, _files()):
            return reason
        rows_and_bounds = sum(qp.sizes.values()) - qp.q.size
        if not rows_and_bounds and self.backend in NEEDS_CONSTRAINT:
            return "needs a constraint: qpsolvers treats QPs without one itself"
        if self.backend == "qtqp" and rows_and_bounds == qp.b.size:
            return "needs an inequality row or a bound"
        needs_rank = self.backend in NEEDS_INDEPENDENT_ROWS
        if needs_rank and (reason := needs_independent_rows(qp)):
            return reason
        dense_only = self.backend in DENSE_ONLY
        return needs_dense(qp, 4) if dense_only else needs_matrices(qp)

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        import qpsolvers

        call = CALLS.get(self.backend, Call())
        options, scale = call.options(tol), objective_factor(qp, call.size)
        takes_dense = self.backend in qpsolvers.dense_solvers
        as_dense = takes_dense and isinstance(qp.P, np.ndarray)
        convert = dense if as_dense or self.backend in DENSE_ONLY else csc
        problem = qpsolvers.Problem(**_arguments(qp, convert, scale))
        if self.backend == "sip":  # it refuses what is not symmetric in the last bit
            problem.P = csc((problem.P + problem.P.T) / 2)
        if self.backend == "highs" and not qp.b.size + qp.h.size:
            # with bounds only, HiGHS claims optima after 0 iterations
            problem.G, problem.h = convert(np.eye(1, qp.q.size)), np.array([np.inf])

        def solve() -> Solution:
            with warnings.catch_warnings():  # they repeat the status
                warnings.simplefilter("ignore")
                try:
                    found = qpsolvers.solve_problem(problem, self.backend, **options)
                except qpsolvers.exceptions.QPError as e:
                    definite = "not positive definite" in str(e)
                    status = Status.DECLINED if definite else Status.FAILED
                    return Solution.without_point(qp, status, str(e))
            return _solution(qp, found, scale)

        return solve


def _files() -> dict[str, Path]:
    return adapter_files("qpsolvers", "solvers/[a-z]*_.py", "_.py")


def _arguments(
    qp: QP, convert: Callable[[Matrix], Matrix], scale: float
) -> dict[str, Any]:
    """Name the parts of `qp` that are there; qpsolvers takes None for absent ones."""
    arguments = {"P": convert(qp.P) * scale, "q": qp.q * scale}
    if qp.h.size:
        arguments |= {"G": convert(qp.G), "h": qp.h.copy()}
    if qp.b.size:
        arguments |= {"A": convert(qp.A), "b": qp.b.copy()}
    for name, bound in (("lb", qp.lb), ("ub", qp.ub)):
        if np.isfinite(bound).any():
            arguments[name] = bound.copy()
    return arguments


def _solution(qp: QP, found: Any, scale: float) -> Solution:
    """Convert a qpsolvers.Solution, in whose sign convention a QP is."""
    info = found.extras.get("info", found.extras)
    info = info if isinstance(info, Mapping) else _attributes(info)
    words = str(info.get("status", "found" if found.found else "not found"))
    status = Status.SOLVED if found.found else _claim(words)
    if status is Status.INFEASIBLE:
        return Solution.without_point(qp, status, words)
    z_box = _vector(found.z_box, qp.q.size, absent=not qp.sizes["bounds"])
    return Solution(
        status=status,
        x=_vector(found.x, qp.q.size),
        y=_vector(found.y, qp.b.size, absent=not qp.b.size) / scale,
        z=_vector(found.z, qp.h.size, absent=not qp.h.size) / scale,
        z_box=on_present_bounds(qp, z_box) / scale,
        iterations=info.get("iter"),
        message=words,
        reported={"linear_solver": name}
        if (name := info.get("lin_sys_solver"))
        else {},
    )


def _attributes(info: object) -> dict[str, Any]:
    names = ("iter", "status")
    return {name: getattr(info, name) for name in names if hasattr(info, name)}


def _claim(words: str) -> Status:
    matches = (s for w, s in WORDS if re.search(w, words, re.IGNORECASE))
    return next(matches, Status.FAILED)


def _vector(v: Any, size: int, *, absent: bool = False) -> Vector:
    """Take a vector as it came; zeros for an absent block, NaN for a missing one."""
    if absent:
        return np.zeros(size)
    if v is None or np.size(v) != size:
        return np.full(size, np.nan)
    return np.asarray(v, dtype=np.float64).ravel()
