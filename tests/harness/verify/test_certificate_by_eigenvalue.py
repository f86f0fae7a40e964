"""Error bounds over convex sets from the least eigenvalue of P.

The solutions are exact: integers times powers of two. P = MᵀM + I with an integer
matrix M has no eigenvalue below one.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.linalg import LinearOperator

import mortarbench as mb
from mortarbench.harness import Case, Solution, Status
from mortarbench.harness.operators import SerialisableOperator
from mortarbench.harness.verify.certificate import (
    PRODUCT_ROUNDING,
    UncertifiableError,
    certify_by_eigenvalue,
)
from mortarbench.harness.verify.verdicts import certified
from tests.harness.verify.test_verdicts_over_discs_and_cones import (
    TRAPS,
    Attack,
    ExactProblem,
)

#: traps that need no rows and leave the eigenvalues of P at one or above
KEPT = [t for t in TRAPS if t not in ("singular", "weak", "touching", "units")]


class WithoutRows:
    """A QP over sets without rows, its solution, and a lower bound on the eigenvalues
    of P.
    """

    def __init__(self, traps, seed, ill=False):
        planted = ExactProblem(traps, seed)
        qp, s = planted.qp, planted.solution
        P = qp.P
        if ill:  # condition numbers up to 1e9, with the same lower bound
            M = (P - np.eye(len(P))) * 2.0**20
            P = M + np.eye(len(P))
        self.least = 1.0
        rows, none = np.zeros((0, qp.q.size)), np.zeros(0)
        self.qp = replace(
            qp, P=P, q=-(P @ s.x + s.z_box), A=rows, b=none, G=rows, h=none
        )
        self.solution = replace(s, y=none, z=none)
        self.value = float(self.qp.objective(s.x))

    def error(self, x):
        """Return ‖x − x*‖_P relative to ‖x*‖_P, in extended precision."""
        e, at = (
            v.astype(np.longdouble) for v in (x - self.solution.x, self.solution.x)
        )
        norm = np.sqrt(at @ (self.qp.P @ at))
        return float(np.sqrt(e @ (self.qp.P @ e)) / norm) if norm else np.inf


def exceeded(seed, tries, each=100):
    """Return failures of bounds, the number of bounds, and the median of bound/error.

    The median is over QPs with well-conditioned P only, since bounds may otherwise be
    too large by the square root of the condition number.
    """
    rng = np.random.default_rng(seed)
    failures, ratios, count = [], [], 0
    with np.errstate(all="ignore"):
        for _ in range(tries // each):
            traps = {str(t) for t in rng.choice(KEPT, rng.integers(0, 3))}
            number, ill = int(rng.integers(2**30)), bool(rng.random() < 0.3)
            planted = WithoutRows(traps, number, ill)
            attack = Attack(planted, rng)
            for k in range(each):
                s = attack.moved(planted.solution, 1e-8)
                s = replace(s, x=0 * s.x) if k % 10 == 0 else s
                try:
                    bound = certify_by_eigenvalue(planted.qp, s, planted.least).bound
                except UncertifiableError:
                    continue
                count += 1
                error = planted.error(s.x)
                if error > bound:
                    failures.append((sorted(traps), number, ill, error, bound))
                if error > 0 and np.isfinite(bound) and not ill:
                    ratios.append(bound / error)
    return failures, count, float(np.median(ratios))


@pytest.mark.parametrize("tries", [200, pytest.param(500, marks=pytest.mark.slow)])
def test_no_bound_of_a_short_search_is_exceeded(tries):
    failures, count, ratio = exceeded(2718, tries)
    assert failures == []
    assert count > 0.9 * tries
    assert ratio < 20


@pytest.mark.parametrize("trap", ["", *KEPT])
def test_the_bound_of_a_solution_is_at_the_level_of_rounding(trap):
    for seed in range(10):
        planted = WithoutRows({trap}, seed)
        found = certify_by_eigenvalue(planted.qp, planted.solution, planted.least)
        assert found.bound <= 1e-9
        assert found.parts["answer"] == found.bound
        for one in planted.qp.sets:
            assert all((l.slack >= -1e-13 * (l.size + l.terms + 1)).all()
                       for l in one.limits(found.x))  # fmt: skip


def test_an_interior_point_is_bounded_without_its_multipliers():
    """For min ½‖x‖² − 5x₁ over the unit disc, the error of (1 − δ, 0) is δ."""
    qp = mb.QP.from_arrays(np.eye(2), [-5, 0], sets=[mb.Discs([[0, 1]], [1])])
    for delta in (1e-3, 1e-6):
        x, none = np.array([1 - delta, 0]), np.zeros(0)
        s = Solution(status=Status.SOLVED, x=x, y=none, z=none, z_box=np.full(2, 7.0))
        found = certify_by_eigenvalue(qp, s, 1.0)
        assert delta <= found.bound <= 1.01 * delta


@pytest.mark.parametrize("stiffness", [0.25, 4.0, 2.0**20])
def test_the_bound_of_an_exact_solution_is_the_rounding_of_its_products(stiffness):
    """For min ½d‖x‖² − dx₁ at (1, 0), r = 0 has terms 2d‖x‖ + ‖q‖ = 3d, and √μ = √d."""
    qp = mb.QP.from_arrays(stiffness * np.eye(2), [-stiffness, 0])
    x, none = np.array([1.0, 0]), np.zeros(0)
    s = Solution(status=Status.SOLVED, x=x, y=none, z=none, z_box=0 * x)
    found = certify_by_eigenvalue(qp, s, stiffness)

    expected = 3 * stiffness**0.5 * PRODUCT_ROUNDING
    assert (found.x == x).all()
    assert found.distance == pytest.approx(expected, rel=1e-9)
    assert found.norm == pytest.approx(stiffness**0.5, rel=1e-12)


class Scaled:
    """The map x ↦ 2x, with a lower bound on its eigenvalues."""

    def __init__(self, least):
        self.least_eigenvalue = least

    def __call__(self, x):
        return 2 * x


@pytest.mark.parametrize("least", [0.5, 0.0, None])
def test_a_case_without_mechanics_is_certified_by_its_operator(least):
    P = SerialisableOperator(3, "scaled", {}, {"scaled": lambda arrays: Scaled(least)})
    row, none = np.zeros((0, 3)), np.zeros(0)
    qp = mb.QP(
        P=P, q=np.array([-6.0, 0, 2]), A=row, b=none, G=row, h=none,
        lb=np.array([-np.inf, -np.inf, 0]), ub=np.full(3, np.inf),
        sets=(mb.Discs([[0, 1]], [1]),),
    )  # fmt: skip
    assert P.least_eigenvalue == least
    case = Case(qp=qp, recover=lambda s: s.x, quantities=lambda s: {})
    s = Solution(
        status=Status.SOLVED, x=np.array([1, 1e-5, 0]), y=none, z=none,
        z_box=np.array([4, 0, -2.0]),
    )  # fmt: skip
    fields, note = certified(case, s)
    assert note == ""
    if least:
        assert 1e-5 <= fields["energy_bound"] <= 1e-4
        assert fields["certificate"]["answer"] == fields["energy_bound"]
        broken = replace(s, x=np.full(3, 1e300))
        assert "too large" in certified(case, broken)[1]
    else:
        assert fields == {}
    assert isinstance(P, LinearOperator)


def test_rows_and_nan_are_refused():
    planted = ExactProblem({"touching"}, 1)
    with pytest.raises(
        UncertifiableError, match="the QP has rows; expected only bounds"
    ):
        certify_by_eigenvalue(planted.qp, planted.solution, 1.0)
    bad = WithoutRows(set(), 1)
    nan = replace(bad.solution, x=bad.solution.x * np.nan)
    with pytest.raises(UncertifiableError, match="NaN or inf"):
        certify_by_eigenvalue(bad.qp, nan, 1.0)
