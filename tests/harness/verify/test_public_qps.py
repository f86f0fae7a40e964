"""Verdicts on public QPs of Maros and Mészáros (1999).

The data are in ../shared, which is not part of the project. Units that do not depend on
the rule follow from `verdict_rule.equilibrate`.
"""

from __future__ import annotations

from collections import Counter
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.sparse import csr_array, eye_array

import mortarbench as mb
from mortarbench.harness import QP, Solution, Status
from mortarbench.harness.verify.kkt import allowed, kkt_residuals
from mortarbench.solvers import SOLVERS
from tests.support import ROOT
from tests.support.limited_solves import limited_solves

SHARED = ROOT.parent / "shared"
MAROS = sorted((SHARED / "data" / "maros").glob("*.QPS"))
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not MAROS, reason="the data are in ../shared"),
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # damaged points overflow
]
TOLERANCES = (1e-4, 1e-6, 1e-8)
NAMES = ("clarabel", "osqp", "piqp", "proxqp", "highs", "daqp", "scs", "qoco")
#: verified answers whose objective is off by more than 100·tol, with the reason
EXCEPTIONS: dict[tuple[str, str, float], str] = {}


def tool(name: str) -> Any:
    """Import a module of ../shared/tools."""
    spec = spec_from_file_location(name, SHARED / "tools" / f"{name}.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def verified(qp: QP, s: Solution, tol: float) -> bool:
    return kkt_residuals(qp, s).worst <= allowed(tol)


@cache
def qp_of(path: Path) -> QP:
    return mb.build(f"file:{path}").family_case.qp


@cache
def optimum(path: Path) -> float:
    """Return f*, on which two of three solvers at a tolerance of 1e-11 agree."""
    qp, values = qp_of(path), []
    for name in ("clarabel", "piqp", "daqp"):
        answer = SOLVERS[name].prepare(qp, 1e-11)()
        if answer.status is Status.SOLVED:
            values.append(qp.objective(answer.x))
    best = float(np.median(values))
    close = [abs(v - best) <= 1e-8 * max(1, abs(best)) for v in values]
    assert sum(close) >= 2, (path.stem, values)
    return best


class Units(NamedTuple):
    """Factors of variables and rows, independent of the rule."""

    D: Any
    E: Any
    F: Any


@cache
def units(path: Path) -> Units:
    qp = qp_of(path)
    diagonal = np.maximum(qp.P.diagonal(), 0)
    return Units(*tool("verdict_rule").equilibrate(diagonal, qp.A, qp.G))


def violation(path: Path, x: Any) -> float:
    """Return the largest violation relative to the terms of the row or bound.

    Rows and bounds with a right-hand side of 0 are relative to at least ‖x̂‖∞.
    """
    qp, by, worst = qp_of(path), units(path), 0.0
    box, X = csr_array(eye_array(x.size)), np.abs(x / by.D).max()
    for M, off, rhs, scale in (
        (qp.A, np.abs(qp.A @ x - qp.b), qp.b, by.E),
        (qp.G, qp.G @ x - qp.h, qp.h, by.F),
        (box, qp.lb - x, qp.lb, 1 / by.D),
        (box, x - qp.ub, qp.ub, 1 / by.D),
    ):
        own = np.where(np.isfinite(rhs), np.abs(rhs), 0)
        size = scale * (own + abs(csr_array(M)) @ np.abs(x))
        size = np.where(rhs == 0, np.maximum(size, X), np.maximum(size, 1e-300))
        worst = max(worst, (scale * np.maximum(off, 0) / size).max(initial=0.0))
    return worst


def test_verdicts_on_answers_of_solvers_agree_with_the_optimum():
    count, wrong, refuted = Counter(), set(), []
    for path in MAROS:
        for name in NAMES:
            for tol, s in limited_solves(path, name, TOLERANCES):
                qp = qp_of(path)
                if not np.isfinite(s.x).all():
                    continue
                passed, best = verified(qp, s, tol), optimum(path)
                error = abs(qp.objective(s.x) - best) / max(1, abs(best))
                count["answers"] += 1
                count["verified"] += passed
                if passed and error > 100 * tol:
                    wrong.add((path.stem, name, tol))
                is_right = max(error, violation(path, s.x)) <= tol
                if s.status is Status.SOLVED and is_right:
                    count["right"] += 1
                    refuted += [] if passed else [(path.stem, name, tol)]

    assert count["answers"] > 550
    assert count["verified"] > 500
    assert wrong <= EXCEPTIONS.keys()
    assert len(EXCEPTIONS) <= 2
    assert len(refuted) <= 0.01 * count["right"], refuted
