"""Claims of infeasible and unbounded QPs, compared with exact solutions."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array, eye_array

from mortarbench.harness import QP, Cones, Discs, Solution, Status, Verdict, no_rows
from mortarbench.harness.conformance.manufactured import (
    infeasible,
    manufactured,
    unbounded,
)
from mortarbench.harness.record import Record
from mortarbench.harness.verify.infeasibility import (
    NO_POINT,
    certificate_of,
    farkas_margin,
    is_ray,
)
from mortarbench.harness.verify.kkt import lengths, rejudged, scaling_of
from mortarbench.harness.verify.verdicts import judged
from tests.support.exact_feasibility import is_feasible, nearly_contradicting
from tests.support.small_qps import at

INF, TOL = np.inf, 1e-8
#: numbers of random QPs
SEARCHED = (20, pytest.param(300, marks=pytest.mark.slow))


def qp_of(A=None, b=(), G=None, h=(), lb=-INF, ub=INF, n=None):
    """Return a QP with P = I and q = 1 from nested lists, which may contain zeros."""
    n = n or np.shape(G if A is None else A)[1]
    A, G = (no_rows(n) if M is None else np.array(M, dtype=float) for M in (A, G))
    b, h = np.array(b, dtype=float), np.array(h, dtype=float)
    lb, ub = (np.array(np.broadcast_to(v, n), dtype=float) for v in (lb, ub))
    return QP(P=np.eye(n), q=np.ones(n), A=A, b=b, G=G, h=h, lb=lb, ub=ub)


def proven(qp, y=None, z=None, tol=TOL):
    """Return True if a claim of infeasibility, perhaps with multipliers, is proven."""
    claim = Solution.without_point(qp, Status.INFEASIBLE)
    if y is not None or z is not None:
        claim = replace(
            claim,
            y=np.zeros(qp.b.size) if y is None else np.array(y, dtype=float),
            z=np.zeros(qp.h.size) if z is None else np.array(z, dtype=float),
        )
    holds, reason = certificate_of(qp, claim, tol)
    assert ("margin" in reason) == holds
    return holds


def unbounded_claim(qp, x=None, tol=TOL):
    """Return True if a claim of unboundedness is proven, and the reason."""
    claim = Solution.without_point(qp, Status.UNBOUNDED)
    claim = claim if x is None else replace(claim, x=np.array(x, dtype=float))
    return certificate_of(qp, claim, tol)


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
    "a bound of 1e12": qp_of(A=[[1, 1]], b=[3e12], ub=1e12),
    "only at the end of a chain": qp_of(
        A=np.eye(30, 31) - np.eye(30, 31, 1), b=np.full(30, 0.1),
        lb=np.where(np.arange(31) == 30, 0.0, -INF),
        ub=np.where(np.arange(31) == 0, 2.9, INF),
    ),
    "a row above a disc": QP.from_arrays(
        np.eye(2), [1, 1], A=[[1, 1]], b=[3], sets=[Discs([[0, 1]], [1])]
    ),
    "a row below a cone": QP.from_arrays(
        np.eye(3), [1, 1, 1], A=[[1, 0, 0]], b=[-1], sets=[Cones([[0, 1, 2]], [1])]
    ),
}  # fmt: skip


@pytest.mark.parametrize("qp", CONTRADICTIONS.values(), ids=CONTRADICTIONS.keys())
def test_a_contradiction_is_proven_without_help_of_the_solver(qp):
    assert proven(qp)


@pytest.mark.parametrize(
    "name",
    sorted(CONTRADICTIONS.keys() - {"a gap of 1e-8"}),  # below the margin
)
@pytest.mark.parametrize("power", [-20, 20])
def test_a_contradiction_is_proven_in_other_units(name, power):
    qp = CONTRADICTIONS[name]
    rng, n = np.random.default_rng(7), qp.q.size
    row, unit = np.exp2(rng.integers(-20, 21, qp.b.size + qp.h.size)), 2.0**power
    A, G = _dense(qp)
    rA, rG = np.split(row, [qp.b.size])
    T = csr_array(unit * eye_array(n))
    sets = [one.substituted(T, np.zeros(n)) for one in qp.sets[1:]]
    scaled = QP(
        P=qp.P * unit**2, q=qp.q * unit, A=rA[:, None] * A * unit, b=rA * qp.b,
        G=rG[:, None] * G * unit, h=rG * qp.h, lb=qp.lb / unit, ub=qp.ub / unit,
        sets=sets,
    )  # fmt: skip
    assert proven(scaled)


def _dense(qp):
    return [M.toarray() if hasattr(M, "toarray") else M for M in (qp.A, qp.G)]


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
    "a length of 1e9 beside 1e-3": qp_of(A=[[1, 0]], b=[1e9], lb=[-INF, 1e-3]),
}  # fmt: skip


@pytest.mark.parametrize("qp", FEASIBLE.values(), ids=FEASIBLE.keys())
@pytest.mark.parametrize("tol", [1e-8, 1e-4])
def test_a_feasible_qp_is_not_proven_to_be_infeasible(qp, tol):
    """All points are tried as multipliers, also those that nearly cancel the rows.

    The rows that are feasible only far away are feasible beyond the radius.
    """
    assert is_feasible(qp)
    rays = np.random.default_rng(1).exponential(size=(5, qp.b.size + qp.h.size))
    cancelling = np.linalg.svd(np.vstack(_dense(qp)).T)[2][-1:]
    for w in (*rays, *cancelling, *-cancelling):
        y, z = np.split(w, [qp.b.size])
        if proven(qp, y, z, tol):
            assert not is_feasible(within_radius(qp, tol))


def within_radius(qp, tol):
    """Return the QP with bounds at the radius of proofs, L/tol."""
    reach = scaling_of(qp).D * lengths(qp).max(initial=0.0) / tol
    return QP(
        P=qp.P, q=qp.q, A=qp.A, b=qp.b, G=qp.G, h=qp.h,
        lb=np.maximum(qp.lb, -reach), ub=np.minimum(qp.ub, reach),
    )  # fmt: skip


def test_rows_that_only_rounding_contradicts_are_not_called_infeasible():
    """The rows are x₁ + x₂ = 0.3 and x₁ + x₂ = 0.1 + 0.2, which are
    different doubles.
    """
    qp = qp_of(A=[[1, 1], [1, 1]], b=[0.3, 0.1 + 0.2])
    assert not is_feasible(qp)
    assert is_feasible(qp, relaxed=1e-12)
    assert not proven(qp)


@pytest.mark.parametrize(
    "z", [(1, -1), (np.nan, 1), (np.inf, 1), (0, 0), (1, 2), (1e-30, 1e-30), (1, 1)]
)
def test_a_useless_ray_does_not_refute_a_true_claim(z):
    assert proven(infeasible(), z=z)


def test_a_margin_is_relative_to_its_terms():
    """The rows x₁ ≤ 1 and −x₁ ≤ −2 with multipliers (s, s): g = s, terms 3s."""
    qp, none = qp_of(G=[[1, 0], [-1, 0]], h=[1, -2]), np.zeros(0)
    for s in (1e-30, 1.0, 1e30):
        margin = farkas_margin(qp, none, np.array([s, s]), TOL)
        assert margin == pytest.approx(1 / 3)
    assert farkas_margin(qp, none, np.array([1.0, -1.0]), TOL) == -1


@pytest.mark.parametrize("n", [20, pytest.param(60, marks=pytest.mark.slow)])
def test_a_combination_that_cancels_only_up_to_rounding_is_proven(n):
    """The last of n + 1 rows is a rounded combination of the other rows."""
    rng = np.random.default_rng(n)
    G, t = rng.standard_normal((n, n)), rng.uniform(1, 2, n)
    G = np.vstack([G, -t @ G])
    above, below = (
        qp_of(G=G, h=np.append(np.ones(n), -t.sum() + gap)) for gap in (1e-2, -1e-2)
    )
    assert proven(below)
    assert not proven(above)
    assert not proven(above, z=np.append(t, 1.0))


@pytest.mark.parametrize("number", SEARCHED)
@pytest.mark.parametrize("tol", [1e-8, 1e-4])
def test_no_proof_of_a_search_is_false(number, tol):
    """Nearly contradicting rows have no point within the radius if they are proven."""
    proofs = 0
    for seed in range(number):
        qp = nearly_contradicting(np.random.default_rng([seed, 1]))
        if proven(qp, tol=tol):
            proofs += 1
            assert not is_feasible(within_radius(qp, tol)), seed
    assert proofs > number / 40


@pytest.mark.parametrize("number", SEARCHED)
def test_no_contradiction_above_the_margin_is_missed(number):
    """Planted multipliers leave a gap of 1e-3 to 1 of the terms, in any units."""
    rng = np.random.default_rng(2)
    for _ in range(number):
        n, m, p = rng.integers(1, 12), rng.integers(0, 4), rng.integers(1, 8)
        M = rng.standard_normal((m + p, n)) * (rng.random((m + p, n)) < 0.7)
        w = np.append(rng.standard_normal(m), rng.exponential(size=p) + 0.1)
        free = rng.random(n) < 0.5
        x = rng.standard_normal(n)
        c = np.where(free, 0, rng.standard_normal(n))
        M[-1] = (c - w[:-1] @ M[:-1]) / w[-1]
        lb = np.where(c > 0, x, -INF)  # cᵀx attains its minimum at x
        ub = np.where(c < 0, x, INF)
        rhs = M @ x
        terms = np.abs(w) @ np.abs(rhs) + np.abs(c) @ np.abs(x)
        rhs[-1] -= 10 ** rng.uniform(-3, 0) * max(terms, 0.1) / w[-1]
        row, unit = 10 ** rng.uniform(-6, 6, m + p), 10 ** rng.uniform(-3, 3, n)
        M, rhs = row[:, None] * M * unit, row * rhs
        assert proven(qp_of(M[:m], rhs[:m], M[m:], rhs[m:], lb / unit, ub / unit, n=n))


# --- unbounded ------------------------------------------------------------------------


with_cost = QP.from_arrays


FALLING = {
    "one variable": (unbounded(), None),
    "linear": (with_cost(np.zeros((2, 2)), [-1, 0]), [1, 0]),
    "along a row": (with_cost(np.zeros((2, 2)), [-1, -1], A=[[1, -1]], b=[5]), [1, 1]),
    "in the kernel of P": (with_cost([[1, -1], [-1, 1]], [-1, -1], lb=0), [1, 1]),
    "in a rounded kernel": (
        with_cost(np.outer([0.1, 0.2, -0.3], [0.1, 0.2, -0.3]), [-1, -1, -1]), [1, 1, 1]
    ),
    "small cost": (with_cost(np.diag([1, 0]), [1, -1e-3], lb=1), [0, 1]),
    "beside a disc": (
        with_cost(np.diag([1, 1, 0]), [0, 0, -1], sets=[Discs([[0, 1]], [1])]),
        [0, 0, 1],
    ),
}  # fmt: skip


@pytest.mark.parametrize(("qp", "ray"), FALLING.values(), ids=FALLING.keys())
def test_an_unbounded_objective_is_proven_with_or_without_a_ray(qp, ray):
    assert unbounded_claim(qp)[0]
    if ray is not None:
        assert is_ray(qp, np.array(ray, dtype=float))
        assert unbounded_claim(qp, ray) == unbounded_claim(qp)
        assert not is_ray(qp, -np.array(ray, dtype=float))


def test_a_ray_in_a_cone_proves_that_the_objective_is_unbounded():
    qp = with_cost(np.zeros((3, 3)), [-1, 0.5, 0], sets=[Cones([[0, 1, 2]], [1])])
    assert unbounded_claim(qp, [1, 0, 0])[0]
    assert not unbounded_claim(qp, [1, -1.01, 0])[0]


BOUNDED = {
    "by a curvature": with_cost([[1e-12]], [-1]),
    "by the stiffness of a contact force": with_cost([[1e-11]], [-1e-3], lb=0, ub=1e20),
    "by a soft variable": with_cost(np.diag([1.0, 1e-12]), [-1, -1], A=[[1, 1]], b=[1]),
    "by a weak direction": with_cost(
        [[1, -1 + 1e-9], [-1 + 1e-9, 1]], [-1, -1], A=[[1, 0]], b=[1]
    ),
    "by a bound": with_cost([[0]], [-1], ub=1e12),
    "by a narrowing wedge": with_cost(
        np.zeros((2, 2)), [-1, 0], G=[[1, -1], [-1 + 1e-9, 1]], h=[0, 0.01]
    ),
    "by a flat cone": with_cost(
        np.zeros((3, 3)), [0, -1, 0], A=[[1, 0, 0]], b=[1],
        sets=[Cones([[0, 1, 2]], [1e-9])],
    ),
    "by a disc": with_cost(np.zeros((2, 2)), [-1, 0], sets=[Discs([[0, 1]], [1e6])]),
    "without descent": with_cost(np.zeros((2, 2)), [1, 0], lb=[0, -INF]),
}  # fmt: skip


@pytest.mark.parametrize("qp", BOUNDED.values(), ids=BOUNDED.keys())
@pytest.mark.parametrize("tol", [1e-8, 1e-4])
def test_a_bounded_objective_is_not_proven_unbounded(qp, tol):
    rays = np.random.default_rng(0).standard_normal((20, qp.q.size))
    for ray in (None, -qp.q, np.ones(qp.q.size), *rays, *np.eye(qp.q.size)):
        holds, reason = unbounded_claim(qp, ray, tol)
        assert (holds, reason) == (False, "no ray of unbounded descent was found")


def test_a_ray_without_a_feasible_point_proves_only_that_the_dual_is_infeasible():
    qp = with_cost(np.zeros((2, 2)), [-1, 0], A=[[0, 1], [0, 1]], b=[0, 1])
    assert is_ray(qp, np.array([1.0, 0]))
    assert unbounded_claim(qp, [1, 0]) == (False, NO_POINT)
    assert judge_claim(qp, Status.UNBOUNDED) == (Verdict.UNBOUNDED_CLAIM, NO_POINT)


@pytest.mark.parametrize("number", SEARCHED)
def test_no_bounded_objective_of_a_search_is_proven_unbounded(number):
    """The minimiser of a QP with nearly flat directions is planted.

    All its lengths are at most 1e6 times those of the data, and P is positive
    semidefinite, so that the objective is bounded.
    """
    rng, tried = np.random.default_rng(3), 0
    for _ in range(number):
        n, m = int(rng.integers(1, 6)), int(rng.integers(0, 3))
        k = int(rng.integers(0, n + 1))
        V = np.linalg.qr(rng.standard_normal((n, n)))[0]
        bends = np.where(np.arange(n) < k, 10 ** rng.uniform(-12, 0, n), 0)
        P = (V * bends) @ V.T
        A = rng.standard_normal((m, n))
        G = rng.standard_normal((2, n))
        x, z = (
            rng.standard_normal(n) * 10 ** rng.uniform(-6, 6),
            rng.exponential(size=2),
        )
        lb = np.where(rng.random(n) < 0.3, x, -INF)
        pull = np.where(np.isfinite(lb), -rng.exponential(size=n), 0)
        q = -(P @ x + G.T @ z + pull + A.T @ rng.standard_normal(m))
        P = (P + P.T) / 2
        if np.linalg.eigvalsh(P)[0] < 0:
            P += 1e-16 * np.eye(n)  # rounding must not make the QP nonconvex
        D, E = 10 ** rng.uniform(-3, 3, n), 10 ** rng.uniform(-6, 6, 2)
        qp = with_cost(
            P * D * D[:, None], q * D, E[:, None] * G * D, E * (G @ x), lb=lb / D,
            **dict(A=A * D, b=A @ x) if m else {},
        )  # fmt: skip
        for ray in (*(V.T / D), *(-V.T / D), None):
            tried += 1
            assert not unbounded_claim(qp, ray)[0]
    assert tried > 2 * number


# --- verdicts -------------------------------------------------------------------------


def record():
    return Record(
        run_id="r", case="c", family="f", params={}, form="primal", sizes={},
        solver="s", options={}, tol=1e-8, repeat=0, block=0, status=Verdict.FAILED,
    )  # fmt: skip


def judge_claim(qp, status):
    found = judged(record(), qp, Solution.without_point(qp, status))
    return found.status, found.message


@pytest.mark.parametrize(
    ("qp", "claimed", "expected"),
    [
        (infeasible(), Status.INFEASIBLE, Verdict.VERIFIED_INFEASIBLE),
        (unbounded(), Status.INFEASIBLE, Verdict.INFEASIBLE_CLAIM),
        (manufactured("everything")[0], Status.INFEASIBLE, Verdict.INFEASIBLE_CLAIM),
        (unbounded(), Status.UNBOUNDED, Verdict.VERIFIED_UNBOUNDED),
        (infeasible(), Status.UNBOUNDED, Verdict.UNBOUNDED_CLAIM),
        (manufactured("everything")[0], Status.UNBOUNDED, Verdict.UNBOUNDED_CLAIM),
        (infeasible(), Status.SOLVED, Verdict.WRONG),
        (infeasible(), Status.FAILED, Verdict.FAILED),
        (unbounded(), Status.TIME_LIMIT, Verdict.TIME_LIMIT),
    ],
)
def test_true_claims_are_verified_and_false_ones_refuted(qp, claimed, expected):
    got = judged(record(), qp, Solution.without_point(qp, claimed))

    assert got.status is expected
    assert got.message or claimed not in (Status.INFEASIBLE, Status.UNBOUNDED)
    for factor in (1e-3, 1, 10, 1e6):
        assert rejudged(Record.from_json(got.to_json()), factor) is expected


def test_a_correct_claim_counts_despite_a_small_violation_of_its_point():
    """For x ≤ 1 and x ≥ 1 + 1e-9, x = 1 has residuals below the tolerance 1e-8."""
    qp = qp_of(G=[[1], [-1]], h=[1, -1 - 1e-9])
    point = at([1], z=[0, 2])
    assert judged(record(), qp, point).status is Verdict.VERIFIED
    claim = replace(point, status=Status.INFEASIBLE)
    assert judged(record(), qp, claim).status is Verdict.VERIFIED_INFEASIBLE
