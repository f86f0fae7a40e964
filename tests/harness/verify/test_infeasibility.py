"""Claims of infeasibility are verified if they are true by more than rounding."""

from dataclasses import replace
from itertools import count
from time import monotonic

import numpy as np
import pytest

from mortarbench.harness import QP, Solution, Status, Verdict, no_rows
from mortarbench.harness.conformance.manufactured import (
    SHAPES,
    infeasible,
    manufactured,
    unbounded,
)
from mortarbench.harness.record import Record
from mortarbench.harness.verify.infeasibility import infeasibility_margin
from mortarbench.harness.verify.kkt import rejudged
from mortarbench.harness.verify.verdicts import judged
from tests.support.exact_feasibility import is_feasible, nearly_contradicting

INF = np.inf


def qp_of(A=None, b=(), G=None, h=(), lb=-INF, ub=INF, n=None):
    n = n or np.shape(G if A is None else A)[1]
    A, G = (no_rows(n) if M is None else np.array(M, dtype=float) for M in (A, G))
    b, h = np.array(b, dtype=float), np.array(h, dtype=float)
    lb, ub = (np.array(np.broadcast_to(v, n), dtype=float) for v in (lb, ub))
    return QP(P=np.eye(n), q=np.ones(n), A=A, b=b, G=G, h=h, lb=lb, ub=ub)


def margin(qp, y=None, z=None):
    claim = Solution.without_point(qp, Status.INFEASIBLE)
    if y is not None or z is not None:
        claim = replace(
            claim,
            y=np.zeros(qp.b.size) if y is None else np.array(y, dtype=float),
            z=np.zeros(qp.h.size) if z is None else np.array(z, dtype=float),
        )
    return infeasibility_margin(qp, claim)


CONTRADICTIONS = {
    "two half-planes": infeasible(),
    "a row without entries": qp_of(G=[[0, 0]], h=[-1]),
    "two equations": qp_of(A=[[1, 2], [2, 4]], b=[1, 3]),
    "a row above all bounds": qp_of(G=[[-1, -1]], h=[-3], lb=0, ub=1),
    "an equation below a bound": qp_of(A=[[1, 1]], b=[-1], lb=0),
    "a gap of 1e-8": qp_of(G=[[1, 0], [-1, 0]], h=[1, -1 - 1e-8]),
    "a cycle of thirds": qp_of(
        G=[[1 / 3, -0.1, 0], [0, 0.1, -1 / 7], [-1 / 3, 0, 1 / 7]], h=[1, 1, -2.1]
    ),
    "badly scaled rows": qp_of(G=[[1e-8, -1e-8], [-1e8, 1e8]], h=[1e-8, -2e8]),
    "a bound of 1e20": qp_of(A=[[1, 1]], b=[3e20], ub=1e20),
    "only at the end of a chain": qp_of(
        A=np.eye(30, 31) - np.eye(30, 31, 1), b=np.full(30, 0.1),
        lb=np.where(np.arange(31) == 30, 0.0, -INF),
        ub=np.where(np.arange(31) == 0, 2.9, INF),
    ),
}  # fmt: skip


@pytest.mark.parametrize("qp", CONTRADICTIONS.values(), ids=CONTRADICTIONS.keys())
def test_a_contradiction_is_proven_without_help_of_the_solver(qp):
    assert margin(qp) > 1e-12


FEASIBLE = {
    "only far away": qp_of(A=[[1, 1], [1, 1 + 2.0**-52]], b=[1, 2]),
    "only at 1e20": qp_of(G=[[-1e-10]], h=[-1e10], ub=1e20),
    "only on a line": qp_of(G=[[1, 1], [-1, -1]], h=[1, -1]),
    "only at a corner": qp_of(G=[[-1, -1]], h=[-2], lb=0, ub=1),
    "threefold but for rounding": qp_of(
        A=[[0.1, 0.2], [0.3, 0.6000000000000001]], b=[0.3, 0.9 + 1e-6]
    ),
    "within a gap of 1e-15": qp_of(G=[[1], [-1]], h=[1 + 1e-15, -1]),
    "decimal rows of 1e8 and 1e-8": qp_of(
        G=[[3e-8, -1e-9], [-6e8, 2e7]], h=[1e-8, -6e8]
    ),
    "rows of 1e8 and 1e-8": qp_of(G=[[1e8], [-1e-8]], h=[1e8, -1e-8]),
}  # fmt: skip


@pytest.mark.parametrize("qp", FEASIBLE.values(), ids=FEASIBLE.keys())
@pytest.mark.parametrize("count", [1, pytest.param(20, marks=pytest.mark.slow)])
def test_a_feasible_qp_is_never_proven_to_be_infeasible(qp, count):
    assert is_feasible(qp)
    rays = np.random.default_rng(1).exponential(size=(count, qp.b.size + qp.h.size))
    cancelling = np.linalg.svd(np.vstack([*map(np.asarray, _dense(qp))]).T)[2][-1:]
    for w in (*rays, *cancelling, *-cancelling):
        assert margin(qp, *np.split(w, [qp.b.size])) is None


def _dense(qp):
    return [M.toarray() if hasattr(M, "toarray") else M for M in (qp.A, qp.G)]


def test_rows_that_only_rounding_contradicts_are_not_called_infeasible():
    """The rows are x₁ + x₂ = 0.3 and x₁ + x₂ = 0.1 + 0.2, which are
    different doubles.
    """
    qp = qp_of(A=[[1, 1], [1, 1]], b=[0.3, 0.1 + 0.2])
    assert not is_feasible(qp)
    assert is_feasible(qp, relaxed=1e-12)
    assert margin(qp) is None


def test_bounds_alone_contradict_nothing():
    assert margin(qp_of(n=2, lb=0, ub=0)) is None


@pytest.mark.parametrize(
    "shape",
    [
        pytest.param(shape, marks=[pytest.mark.slow] * (shape in ("singular", "fixed")))
        for shape in SHAPES
    ],
)
def test_qps_with_planted_solutions_are_not_proven_infeasible(shape):
    assert margin(manufactured(shape)[0]) is None


@pytest.mark.parametrize("z", [(1, 1 + 1e-9), (1e-30, 1e-30), (1e200, 1e200)])
def test_the_ray_of_a_solver_is_corrected_before_its_check(z):
    """All variables are free, so Gᵀz must vanish; the entries for z = (1, 1 + 1e-9) are
    ∓1e-9.
    """
    assert margin(infeasible(), z=z) == 1


@pytest.mark.parametrize("z", [(1, -1), (np.nan, 1), (np.inf, 1), (0, 0), (1, 2)])
def test_a_useless_ray_does_not_refute_a_true_claim(z):
    assert margin(infeasible(), z=z) == 1


def test_units_of_rows_and_variables_change_no_margin():
    rng = np.random.default_rng(7)
    qp = CONTRADICTIONS["a cycle of thirds"]
    expected = margin(qp)
    for _ in range(10):
        row, column = (np.exp2(rng.integers(-40, 40, 3)) for _ in range(2))
        scaled = replace(
            qp, G=row[:, None] * qp.G * column, h=row * qp.h,
            A=qp.A, lb=qp.lb / column, ub=qp.ub / column,
        )  # fmt: skip
        assert margin(scaled) == pytest.approx(expected, 1e-9)


@pytest.mark.parametrize("n", [60, pytest.param(150, marks=pytest.mark.slow)])
def test_a_large_contradiction_of_reals_is_proven_by_an_enclosure(n):
    """The last of n + 1 rows is a rounded combination of the other rows.

    The combination does not cancel exactly, but an exact ray is nearby, since the other
    rows are independent.
    """
    rng = np.random.default_rng(n)
    G, t = rng.standard_normal((n, n)), rng.uniform(1, 2, n)
    G = np.vstack([G, -t @ G])
    ray = np.append(t, 1.0)
    above, below = (
        qp_of(G=G, h=np.append(np.ones(n), -t.sum() + gap)) for gap in (1e-3, -1e-3)
    )
    assert (ray.astype(np.longdouble) @ G != 0).any()
    assert margin(below) == pytest.approx(1e-3 / (2 * t.sum()), 1e-3)
    assert margin(below, z=ray * (1 + 1e-7 * rng.standard_normal(n + 1))) is not None
    assert margin(above) is None
    assert margin(above, z=ray) is None


def record():
    return Record(
        run_id="r", case="c", family="f", params={}, form="primal", sizes={},
        solver="s", options={}, tol=1e-8, repeat=0, block=0, verdict=Verdict.FAILED,
    )  # fmt: skip


def test_a_correct_infeasibility_claim_is_verified_and_a_wrong_one_refuted():
    for qp, expected in (
        (infeasible(), Verdict.VERIFIED_INFEASIBLE),
        (unbounded(), Verdict.INFEASIBLE_CLAIM),
        (manufactured("everything")[0], Verdict.INFEASIBLE_CLAIM),
    ):
        got = judged(record(), qp, Solution.without_point(qp, Status.INFEASIBLE))
        assert got.verdict is expected
        for factor in (1e-3, 1, 10, 1e6):
            assert rejudged(Record.from_json(got.to_json()), factor) is expected


def test_other_claims_on_an_infeasible_qp_keep_their_verdicts():
    qp = infeasible()
    for claimed, expected in (
        (Status.SOLVED, Verdict.WRONG),
        (Status.FAILED, Verdict.FAILED),
        (Status.TIME_LIMIT, Verdict.TIME_LIMIT),
    ):
        got = judged(record(), qp, Solution.without_point(qp, claimed))
        assert got.verdict is expected


def test_a_correct_claim_counts_despite_a_small_violation_of_its_point():
    """For x ≤ 1 and x ≥ 1 + 1e-9, x = 1 has residuals below the tolerance 1e-8."""
    qp = qp_of(G=[[1], [-1]], h=[1, -1 - 1e-9])
    point = Solution(
        status=Status.SOLVED, x=np.ones(1), y=np.zeros(0), z=np.array([0.0, 2.0]),
        z_box=np.zeros(1),
    )  # fmt: skip
    assert judged(record(), qp, point).verdict is Verdict.VERIFIED
    claim = replace(point, status=Status.INFEASIBLE)
    assert judged(record(), qp, claim).verdict is Verdict.VERIFIED_INFEASIBLE


def search(seeds):
    """Return the number of proofs; assert that none is false and that none is missing.

    A proof is required if the QP stays infeasible when right-hand sides and bounds are
    relaxed by 1e-11 of their size.
    """
    proofs = 0
    for seed in seeds:
        qp = nearly_contradicting(np.random.default_rng(seed))
        if margin(qp) is not None:
            proofs += 1
            assert not is_feasible(qp), seed
        else:
            assert is_feasible(qp, relaxed=1e-11), seed
    return proofs


@pytest.mark.parametrize(
    ("count", "proofs"),
    [(12, 1), *(pytest.param(*n, marks=pytest.mark.slow) for n in ((24, 2), (60, 5)))],
)
def test_all_infeasibility_proofs_of_a_short_search_are_correct(count, proofs):
    assert search(range(count)) >= proofs


@pytest.mark.slow
def test_all_infeasibility_proofs_of_a_long_search_are_correct():
    end = monotonic() + 90
    seeds = count(10**6)
    assert (
        sum(search([next(seeds)]) for _ in iter(lambda: monotonic() < end, False)) > 50
    )
