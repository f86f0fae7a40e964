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
from typing import Any

import numpy as np

from harness import QP, Matrix, Solution, Status, Vector
from solvers.backends import adapter_files, why_not
from solvers.conversion import (
    NEGLIGIBLE,
    csc,
    dense,
    needs_matrices,
    on_present_bounds,
)

#: backend → keywords that get tol, and keywords with a fixed value
KEYWORDS: Mapping[str, tuple[tuple[str, ...], Mapping[str, Any]]] = {
    "clarabel": (("tol_feas", "tol_gap_abs", "tol_gap_rel"), {"max_threads": 1}),
    "cvxopt": (("feastol", "abstol", "reltol"), {}),
    "daqp": (("primal_tol", "dual_tol"), {}),
    "highs": (
        ("primal_feasibility_tolerance", "dual_feasibility_tolerance"),
        # HiGHS else adds 1e-7 to the Hessian and drops entries below 1e-9
        {"qp_regularization_value": 0.0, "small_matrix_value": 1e-12, "threads": 1},
    ),
    "osqp": (
        ("eps_rel",),
        {"eps_abs": NEGLIGIBLE, "max_iter": 1_000_000, "raise_error": False},
    ),
    "piqp": (
        ("eps_rel", "eps_duality_gap_rel"),
        {"eps_abs": NEGLIGIBLE, "eps_duality_gap_abs": NEGLIGIBLE},
    ),
    "proxqp": (
        ("eps_rel", "eps_duality_gap_rel"),
        {
            "eps_abs": NEGLIGIBLE,
            "eps_duality_gap_abs": NEGLIGIBLE,
            "check_duality_gap": True,
        },
    ),
    "qpalm": (("eps_rel",), {"eps_abs": NEGLIGIBLE}),
    "qtqp": (("tol_feas", "tol_gap_abs", "tol_gap_rel"), {}),
    "scs": (("eps_rel",), {"eps_abs": NEGLIGIBLE, "max_iters": 1_000_000}),
}

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

    The tolerance goes to the backend's own keywords (`KEYWORDS`), the relative one
    where there are two; a backend that is not listed there runs at its defaults. Where
    the backend's test is absolute (clarabel, highs, daqp, …) so is the accuracy: the QP
    is handed over as it is. Backends that take both get dense matrices where P is
    dense. qpsolvers tells the iterations of some backends only.
    """

    backend: str = ""  #: the NAME in qpsolvers:NAME

    @staticmethod
    def backends() -> tuple[str, ...]:
        """List the names that the installed qpsolvers knows, installed or not."""
        return tuple(_files())

    def declines(self, qp: QP) -> str | None:
        return why_not("qpsolvers", self.backend, _files()) or needs_matrices(qp)

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        import qpsolvers

        tolerances, fixed = KEYWORDS.get(self.backend, ((), {}))
        options = {**dict.fromkeys(tolerances, tol), **fixed}
        takes_dense = self.backend in qpsolvers.dense_solvers
        convert = dense if takes_dense and isinstance(qp.P, np.ndarray) else csc
        problem = qpsolvers.Problem(**_arguments(qp, convert))

        def solve() -> Solution:
            with warnings.catch_warnings():  # they repeat the status
                warnings.simplefilter("ignore")
                try:
                    found = qpsolvers.solve_problem(problem, self.backend, **options)
                except qpsolvers.exceptions.QPError as e:
                    return Solution.without_point(qp, Status.FAILED, str(e))
            return _solution(qp, found)

        return solve


def _files() -> dict[str, Path]:
    return adapter_files("qpsolvers", "solvers/[a-z]*_.py", "_.py")


def _arguments(qp: QP, convert: Callable[[Matrix], Matrix]) -> dict[str, Any]:
    """Name the parts of `qp` that are there; qpsolvers takes None for absent ones."""
    arguments = {"P": convert(qp.P), "q": qp.q.copy()}
    if qp.h.size:
        arguments |= {"G": convert(qp.G), "h": qp.h.copy()}
    if qp.b.size:
        arguments |= {"A": convert(qp.A), "b": qp.b.copy()}
    for name, bound in (("lb", qp.lb), ("ub", qp.ub)):
        if np.isfinite(bound).any():
            arguments[name] = bound.copy()
    return arguments


def _solution(qp: QP, found: Any) -> Solution:
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
        y=_vector(found.y, qp.b.size, absent=not qp.b.size),
        z=_vector(found.z, qp.h.size, absent=not qp.h.size),
        z_box=on_present_bounds(qp, z_box),
        iterations=info.get("iter"),
        message=words,
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
