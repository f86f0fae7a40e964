"""Optima and multipliers over convex sets, compared with rational solutions.

Components of planted solutions are small integers times powers of two; on balls, they
form Pythagorean pairs. Therefore f* and all errors are known without rounding.
"""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from mortarbench.harness import QP, Solution, Status
from mortarbench.harness.verify.kkt import kkt_residuals, own_sizes
from mortarbench.harness.verify.multipliers import with_multipliers
from mortarbench.harness.verify.optimum import proven_optimum
from mortarbench.harness.verify.rational import rational
from mortarbench.harness.verify.scales import TERMS_FACTOR
from mortarbench.solvers.reference.solve import reference_solution
from tests.harness.test_sets import with_solution
from tests.harness.verify.test_proven_optimum import Attack
from tests.support.balls import Balls

INF = np.inf
PAIRS = [(3, 4, 5), (5, 12, 13), (8, 15, 17), (-7, 24, 25), (4, -3, 5)]
#: traps, which are tested singly and in pairs
TRAPS = ("singular", "cancelled", "tiny ball", "wide ball", "weak", "units", "point")


class ExactProblem:
    """A QP over balls, bounds and rows, with its exact solution and f*."""

    def __init__(self, traps, seed):
        rng = np.random.default_rng(seed)
        k, alone, m, p = rng.integers(1, 4), rng.integers(1, 4), *rng.integers(0, 3, 2)
        n = 2 * k + alone
        order = rng.permutation(n)
        index, others = order[: 2 * k].reshape(k, 2), order[2 * k :]
        x, z = rng.integers(-4, 5, n).astype(float), np.zeros(n)
        radius = np.zeros(k)
        for i, block in enumerate(index):
            a, b, c = PAIRS[rng.integers(len(PAIRS))]
            unit = 2.0 ** (-8 if "tiny ball" in traps and i == 0 else 0)
            x[block], radius[i] = unit * np.array([a, b]), unit * c
            if rng.random() < 0.7:  # active; otherwise, the ball is larger
                z[block] = rng.integers(1, 9) * np.array([a, b])
            else:
                radius[i] *= 2.0 ** (40 if "wide ball" in traps else 1)
        if "point" in traps:  # any force is normal to a ball of radius zero
            x[index[-1]], radius[-1] = 0, 0
            z[index[-1]] = rng.integers(-9, 10, 2)
        lb, ub = np.full(n, -INF), np.full(n, INF)
        for j in others:
            lb[j], ub[j] = x[j] - rng.integers(0, 2), x[j] + rng.integers(1, 9)
            z[j] = -float(rng.integers(0, 4)) if lb[j] == x[j] else 0
        M = rng.integers(-3, 4, (n - (2 if "singular" in traps else 0), n))
        P = (M.T @ M).astype(float)
        if "weak" in traps:
            P *= 2.0**-20
        A, G = (rng.integers(-3, 4, (r, n)).astype(float) for r in (m, p))
        y = rng.integers(-9, 10, m) * (2.0**20 if "cancelled" in traps else 1)
        mu = rng.integers(0, 9, p).astype(float)
        h = G @ x + np.where(mu == 0, rng.integers(0, 9, p), 0)
        u = 2.0**30 if "units" in traps else 1.0
        q = -(P @ x + A.T @ y + G.T @ mu + z)
        self.qp = QP(
            P=P / u**2, q=q / u, A=A, b=u * (A @ x), G=G, h=u * h, lb=u * lb, ub=u * ub,
            sets=(Balls(index, u * radius),),
        )  # fmt: skip
        self.solution = Solution(
            status=Status.SOLVED, x=u * x, y=y / u, z=mu / u, z_box=z / u
        )
        self.exact = exact_objective(self.qp, u * x)
        self.value = float(self.exact)


def exact_objective(qp, x):
    P, q, x = rational(qp.P), rational(qp.q), rational(x)
    return x @ (P @ x) / 2 + q @ x


@pytest.mark.parametrize("trap", ["", *TRAPS])
def test_planted_points_over_balls_are_solutions_to_the_last_digit(trap):
    for seed in range(10):
        planted = ExactProblem({trap}, seed)
        qp, s = planted.qp, planted.solution
        balls = qp.sets[1]
        force = qp.P @ s.x + qp.q + qp.A.T @ s.y + qp.G.T @ s.z + s.z_box
        assert not force.any()
        assert (qp.A @ s.x == qp.b).all()
        assert (qp.G @ s.x <= qp.h).all()
        assert (s.z * (qp.h - qp.G @ s.x) == 0).all()
        assert ((qp.lb <= s.x) & (s.x <= qp.ub)).all()
        for block, radius in zip(balls.index, balls.radius, strict=True):
            x, z = ([Fraction(c) for c in v[block]] for v in (s.x, s.z_box))
            assert x[0] ** 2 + x[1] ** 2 <= Fraction(radius) ** 2
            if radius and any(z):  # normal: along x, and x is on the boundary
                assert x[0] * z[1] == x[1] * z[0]
                assert x[0] * z[0] + x[1] * z[1] > 0
                assert x[0] ** 2 + x[1] ** 2 == Fraction(radius) ** 2


class AttackOverSets(Attack):
    """Attack with projections onto the sets instead of bounds."""

    def project(self, x):
        for one in self.qp.sets:
            x = one.project(x)
        return x

    def rounded(self):
        s = super().rounded()
        return replace(s, x=self.project(s.x))

    def violation(self, x, at):
        """Return the largest violation of a row, bound or ball, relative to its terms.

        The terms of a ball include the shifts of its variables by other variables, as
        in `own_sizes`. Near the edge of a contact zone, the radius of a friction disc
        vanishes. Errors relative to that radius alone would refute every answer that a
        conic solver computes in double precision. A radius of zero defines no length.
        """
        balls = self.qp.sets[1]
        own = np.maximum(own_sizes(self.qp, self.s.x) / TERMS_FACTOR, at)
        off = np.linalg.norm(x[balls.index], axis=1) - balls.radius
        size = balls.radius + np.linalg.norm(own[balls.index], axis=1)
        has_length = balls.radius > 0
        worst = (off[has_length] / size[has_length]).max(initial=0.0)
        return max(worst, super().violation(x, at))

    def moved(self, s):
        s = super().moved(s)
        if self.rng.random() < 0.5:
            s = replace(s, x=self.project(s.x))
        if self.rng.random() < 0.3:
            s = with_multipliers(self.qp, s.x)
        return s


def search(seed, tries, each=40):
    """Attack QPs with up to two traps; return wrong verdicts and counts.

    If no optimum is proven, residuals decide the verdict. They permit a violation of a
    ball relative to the shifts of its variables by other variables.
    """
    rng = np.random.default_rng(seed)
    wrong, refuted, verified, proven = [], [], 0, 0
    with np.errstate(all="ignore"):
        for _ in range(tries // each):
            traps = {str(t) for t in rng.choice(TRAPS, rng.integers(0, 3))}
            number = int(rng.integers(2**30))
            planted = ExactProblem(traps, number)
            attack = AttackOverSets(
                planted, rng, is_unique=not traps & {"singular", "weak"}
            )
            optimum = attack.prove(planted.qp)
            if optimum is not None:
                proven += 1
                off = abs(Fraction(optimum.value) - planted.exact)
                assert off <= optimum.doubt, (traps, number)
            for _ in range(3):
                s = attack.rounded()
                if attack.error(s) < 1e-9 and not attack.verified(s):
                    refuted.append((sorted(traps), number))
            for s in attack.points(each - 3):
                if attack.verified(s):
                    verified += 1
                    is_wrong = optimum is not None and attack.is_wrong(s)
                    if attack.error(s) > 1e-3 or is_wrong:
                        wrong.append((sorted(traps), number, s.x))
    return wrong, refuted, verified, proven / (tries // each)


@pytest.mark.parametrize(
    ("tries", "each"), [(100, 20), pytest.param(400, 40, marks=pytest.mark.slow)]
)
def test_no_verdict_is_wrong_in_a_short_search_over_sets(tries, each):
    wrong, refuted, verified, proven = search(271828, tries, each)

    assert (wrong, refuted) == ([], [])
    assert verified > 15
    assert proven > 0.8


@pytest.mark.slow
def test_no_verdict_is_wrong_in_a_long_search_over_sets():
    wrong, refuted, verified, proven = search(314159, 25_000)

    assert (wrong, refuted) == ([], [])
    assert verified > 1000
    assert proven > 0.8


@pytest.mark.parametrize("seed", range(10))
def test_the_reference_solves_qps_over_balls_to_their_rounding(seed):
    qp, planted = with_solution(seed)
    s = reference_solution(qp)

    assert kkt_residuals(qp, s).worst <= 1e-14
    assert s.x == pytest.approx(planted.x, abs=1e-13)


@pytest.mark.slow
def test_a_reference_of_contradicting_rows_and_balls_is_refused():
    balls = Balls(np.array([[0, 1]]), np.ones(1))
    row = np.ones((1, 2))
    qp = QP(
        P=np.eye(2), q=np.ones(2), A=row, b=np.array([3.0]), G=row[:0], h=np.zeros(0),
        sets=(balls,),
    )  # fmt: skip
    with pytest.raises(ArithmeticError, match="found no optimal point"):
        reference_solution(qp)
    assert proven_optimum(qp, reference_solution) is None


@pytest.mark.parametrize("seed", range(10))
def test_multipliers_of_a_solution_over_balls_prove_it(seed):
    qp, s = with_solution(seed)

    assert kkt_residuals(qp, with_multipliers(qp, s.x)).worst <= 1e-13
    assert kkt_residuals(qp, with_multipliers(qp, s.x, s.y, s.z)).worst <= 1e-13


@pytest.mark.parametrize(
    "trap",
    ["point", *(
        pytest.param(trap, marks=pytest.mark.slow) for trap in ("", *TRAPS)
        if trap not in ("tiny ball", "point")
    )],
)  # fmt: skip
def test_multipliers_over_balls_are_computed_also_with_common_rows(trap):
    """Solutions are rounded, so they are on the spheres only up to rounding."""
    worst = []
    for seed in range(20):
        planted = ExactProblem({trap}, seed)
        rng = np.random.default_rng(seed)
        x = planted.solution.x * (1 + 2.0**-40 * rng.standard_normal(planted.qp.q.size))
        worst.append(kkt_residuals(planted.qp, with_multipliers(planted.qp, x)).worst)

    assert np.median(worst) <= 1e-11
    assert np.quantile(worst, 0.9) <= 1e-7


@pytest.mark.parametrize("count", [6, pytest.param(20, marks=pytest.mark.slow)])
def test_no_multipliers_verify_a_non_optimal_point(count):
    for seed in range(count):
        qp, s = with_solution(seed)
        x = qp.sets[1].project(s.x * (1 + 1e-2 * np.sign(s.x)))
        assert kkt_residuals(qp, with_multipliers(qp, x)).worst > 1e-4
