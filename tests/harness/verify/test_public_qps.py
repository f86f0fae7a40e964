"""Verdicts on planted points and on public QPs of Maros and Mészáros (1999).

The data and the search on planted points are in ../shared, which is not part of the
project. Units that do not depend on the rule are those of the search, or follow from
`verdict_rule.equilibrate`.
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
from tests.support.small_qps import at

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


# --- planted points -------------------------------------------------------------------


def test_at_most_four_in_a_thousand_planted_points_are_judged_wrongly():
    """The search contains 7500 wrong and 5000 right points; rates were 0.07, 0.12 %."""
    planted, total = tool("planted_points"), Counter()

    def is_verified(data, point, tol):
        P, q, A, b, G, h, lb, ub = data
        qp = QP(P=(P + P.T) / 2, q=q, A=A, b=b, G=G, h=h, lb=lb, ub=ub)
        return verified(qp, at(*point), tol)

    for seed in range(1, 11):
        total.update(planted.search(is_verified, 150, seed)[0])

    assert total["wrong"] > 7000
    assert total["right"] > 4500
    assert total["false verified"] <= 0.004 * total["wrong"]
    assert total["false refuted"] <= 0.004 * total["right"]


# --- answers of solvers ---------------------------------------------------------------


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


# --- damaged points -------------------------------------------------------------------


def accurate(path: Path) -> Solution:
    qp = qp_of(path)
    answers = [SOLVERS[name].prepare(qp, 1e-12)() for name in ("clarabel", "piqp")]
    best = min(answers, key=lambda s: kkt_residuals(qp, s).worst)
    assert kkt_residuals(qp, best).worst <= 1e-8, path.stem
    return best


def test_few_damaged_points_of_public_qps_are_verified():
    """Points are damaged in units in which the QP is balanced.

    Damaged multipliers count if they change the gradient by more than 100·tol of the
    largest force.
    """
    planted, rng = tool("planted_points"), np.random.default_rng(0)
    count, passed = 0, []
    for path in MAROS:
        qp, by, s = qp_of(path), units(path), accurate(path)
        P, A, G = (
            scale[:, None] * csr_array(M).toarray() * by.D
            for scale, M in ((by.D, qp.P), (by.E, qp.A), (by.F, qp.G))
        )
        c = 1 / max(np.abs(P).max(), np.abs(by.D * qp.q).max())
        lb, ub = qp.lb / by.D, qp.ub / by.D
        data = [c * P, c * by.D * qp.q, A, by.E * qp.b, G, by.F * qp.h, lb, ub]
        x = np.clip(s.x / by.D, lb, ub)
        point = [x, c * s.y / by.E, c * s.z / by.F, c * by.D * s.z_box]
        active = point[2] > 1e-8 * max(1e-300, np.abs(point[2]).max(initial=0))
        value = x @ data[0] @ x / 2 + data[1] @ x
        force = max(np.abs(data[0] @ x).max(), np.abs(data[1]).max())
        force = max(force, 0.1 * np.abs(data[0]).max() * np.abs(x).max())
        for tol in TOLERANCES * 3:
            for label, kind, moved in planted.points(rng, data, point, active, tol):
                error, off = planted.truth(data, moved, x, tol, value, label)
                wrong = max(error, off) > 100 * tol
                if kind == 2:  # other multipliers
                    dy, dz, dbox = (moved[k] - point[k] for k in (1, 2, 3))
                    change = A.T @ dy + G.T @ dz + dbox
                    wrong = np.abs(change).max() > 100 * tol * force
                if not wrong:
                    continue
                back = at(
                    by.D * moved[0], by.E * moved[1] / c, by.F * moved[2] / c,
                    moved[3] / by.D / c,
                )  # fmt: skip
                count += 1
                if verified(qp, back, tol):
                    passed.append((path.stem, tol, label, error, off))

    assert count > 1000
    assert len(passed) <= 0.025 * count, passed
