"""Preconditioners and step rules of subclasses: use, safeguards, one-line refusals."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.sparse import csr_array

from mortarbench.harness import QP, Status, no_rows
from mortarbench.harness.registry import options_of
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.solvers.smalbe.solver import SMALBE


def bounded(P, q, lb, ub=None, rows=None):
    """Return the QP min ½xᵀPx + qᵀx with bounds and, optionally, rows Ax = 0."""
    n = len(q)
    rows = no_rows(n) if rows is None else rows
    return QP(
        P=P, q=q, A=rows, b=np.zeros(rows.shape[0]), G=no_rows(n), h=np.zeros(0),
        lb=lb, ub=np.full(n, np.inf) if ub is None else ub,
    )  # fmt: skip


def spd(n, seed, condition=1e3):
    rng = np.random.default_rng(seed)
    V = np.linalg.qr(rng.standard_normal((n, n)))[0]
    return (V * np.geomspace(1, condition, n)) @ V.T


def qp_with_solution(n, seed):
    """Draw a QP with the row sum x = 0, a box, and a solution that is known by
    construction.
    """
    rng = np.random.default_rng(seed)
    P, x = spd(n, seed), rng.standard_normal(n)
    x -= x.mean()
    side = rng.integers(-1, 2, n)  # −1 at the lower bound, 1 at the upper one
    lb = np.where(side < 0, x, x - rng.uniform(0.1, 1, n))
    ub = np.where(side > 0, x, x + rng.uniform(0.1, 1, n))
    z = side * rng.uniform(0.1, 1, n)
    return bounded(P, -P @ x - z - 0.3, lb, ub, np.ones((1, n))), x


@dataclass(frozen=True)
class WithM(SMALBE):
    """SMALBE with a preconditioner that depends on the QP and v."""

    inverse: object = None

    def preconditioner_for(self, qp):
        return lambda v: self.inverse(qp, v)


@dataclass(frozen=True)
class WithRule(SMALBE):
    """SMALBE with a step rule."""

    rule: object = None

    def step_rule_for(self, qp):
        return self.rule


PLAIN = dict(recycle=False)


def test_the_inverse_as_preconditioner_needs_one_cg_step():
    """With P⁻¹, CG reaches the unconstrained minimum in one step for any condition
    number.
    """
    n = 40
    P, q = spd(n, 1, 1e6), np.linspace(1, 2, n)
    qp = bounded(P, q, np.full(n, -1e9))
    plain = SMALBE(preconditioner="none", **PLAIN).prepare(qp, 1e-8)()
    s = WithM(inverse=lambda qp, v: np.linalg.solve(qp.P, v), **PLAIN).prepare(
        qp, 1e-8
    )()

    assert s.status is Status.SOLVED
    assert s.counts["cg"] <= 2  # a second step may remove rounding errors
    assert plain.counts["cg"] > 10


def test_a_copy_of_a_built_in_preconditioner_takes_the_same_steps():
    qp, _ = qp_with_solution(30, 2)
    ours = SMALBE(preconditioner="diagonal", **PLAIN).prepare(qp, 1e-8)()
    own = WithM(inverse=lambda qp, v: 1 / qp.P.diagonal() * v, **PLAIN).prepare(
        qp, 1e-8
    )()

    assert own.counts == ours.counts
    assert (own.x == ours.x).all()


def test_a_step_rule_receives_the_problem_in_its_original_units():
    """The rule receives g = Px + q, both step lengths as defined, and p, a direction in
    which the cost increases.
    """
    n, seen = 12, []
    P, q = 1e7 * spd(n, 3), np.linspace(-1e8, 2e8, n)
    qp = bounded(P, q, np.full(n, -1e-2), np.full(n, 2e-2))

    def rule(step):
        seen.append(step)
        return step.x - step.alpha_f * step.p

    WithRule(rule=rule).prepare(qp, 1e-6)()

    assert seen
    for x, g, p, lb, ub, cg, feasible, bar in seen:
        assert g == pytest.approx(P @ x + q, rel=1e-6, abs=1e-6 * abs(q).max())
        assert cg == pytest.approx(g @ p / (p @ P @ p), rel=1e-6)
        room = np.where(p > 0, x - lb, ub - x)[p != 0] / abs(p[p != 0])
        assert feasible == pytest.approx(room.min(), rel=1e-9)
        assert feasible < cg
        assert g @ p > 0
        assert 1 / np.linalg.norm(P, 2) < bar <= 2 / np.linalg.norm(P, 2)
        assert (lb == qp.lb).all()
        assert (ub == qp.ub).all()


def test_a_trial_point_outside_is_projected():
    """For P = I, the projection of the unconstrained minimum is the solution, so one
    step suffices.
    """
    n = 20
    q = np.linspace(-1, 1, n)
    qp = bounded(np.eye(n), q, np.full(n, -0.3), np.full(n, 0.4))
    s = WithRule(rule=lambda step: step.x - step.g).prepare(qp, 1e-10)()

    assert s.status is Status.SOLVED
    assert s.x == pytest.approx(np.clip(-q, -0.3, 0.4), abs=1e-12)
    assert s.counts["expansion"] == 1
    assert "fallback" not in s.counts


RULES = {
    "stays": lambda step: step.x,
    "climbs": lambda step: step.x + step.alpha_bar * step.g,
    "far": lambda step: step.x - 1e12 * step.g,
    "corner": lambda step: np.where(np.isfinite(step.lb), step.lb, step.ub),
    "creeps": lambda step: step.x - 1e-9 * step.alpha_f * step.p,
    "random": lambda step: np.random.default_rng(0).normal(size=step.x.size),
    "projected cg": lambda step: step.x - step.alpha_cg * step.p,
}


@pytest.mark.parametrize("name", RULES)
def test_no_step_rule_affects_accuracy_or_increases_the_cost(name):
    """Bad rules may require more products, but the cost does not increase in any step,
    and the planted solutions are found.
    """
    for seed in range(20):
        qp, x = qp_with_solution(25, seed)
        solver = WithRule(rule=RULES[name], preconditioner="none", history=True)
        s = solver.prepare(qp, 1e-8)()

        assert s.status is Status.SOLVED
        assert kkt_residuals(qp, s).worst <= 5e-8
        assert np.linalg.norm(s.x - x) <= 1e-5 * np.linalg.norm(x)
        cost, outer = s.history["cost"], s.history["outer"]
        fall = np.diff(cost)[np.diff(outer) == 0]
        assert (fall <= 1e-9 * abs(cost).max()).all()


@pytest.mark.parametrize(
    ("M", "message"),
    [
        (lambda qp, v: -v, "vᵀMv = -.*; expected a positive number"),
        (lambda qp, v: v * np.nan, "vᵀMv = nan; expected a positive number"),
        (lambda qp, v: v[:-1], r"returned shape \(24,\); expected \(25,\)"),
    ],
)
def test_an_invalid_preconditioner_is_refused(M, message):
    qp, _ = qp_with_solution(25, 5)
    with pytest.raises(ValueError, match=message):
        WithM(inverse=M).prepare(qp, 1e-8)()


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        (lambda step: step.x * np.inf, "a point that is not finite"),
        (lambda step: step.x[1:], "trial point .* has 24 components; expected 25"),
    ],
)
def test_a_rule_that_returns_no_point_is_refused(rule, message):
    qp, _ = qp_with_solution(25, 5)
    with pytest.raises(ValueError, match=message):
        WithRule(rule=rule).prepare(qp, 1e-8)()


def test_in_a_sequence_the_functions_receive_every_variable():
    n, sizes = 30, []
    lb = np.where(np.arange(n) < 10, -np.inf, 0.0)
    qps = [bounded(spd(n, 6), np.linspace(-1, k, n), lb) for k in (1, 2, 3)]

    def M(qp, v):
        sizes.append(v.size)
        return v / qp.P.diagonal()

    prepare = WithM(inverse=M).chain(1e-8)
    answers = [prepare(qp)() for qp in qps]

    assert set(sizes) == {n}
    assert all(
        kkt_residuals(qp, s).worst <= 5e-8 for qp, s in zip(qps, answers, strict=True)
    )


@pytest.mark.parametrize("kind", [WithM, WithRule])
def test_incomplete_factors_are_refused_not_ignored(kind):
    """With `auto`, another preconditioner is
    used instead.
    """
    with pytest.raises(ValueError, match="preconditioner = 'incomplete' replaces"):
        kind(preconditioner="incomplete")


def test_a_step_rule_receives_a_sparse_qp_in_its_original_variables():
    """`auto` would use a factor; the rule receives x and the bounds."""
    n, steps = 60, []
    P = 1e4 * csr_array(2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    qp = bounded(P, np.linspace(-3, -1, n), np.full(n, -1.0), np.full(n, 5e-3))

    def rule(step):
        steps.append(step)
        return step.x - step.alpha_cg * step.p

    s = WithRule(rule=rule).prepare(qp, 1e-8)()

    assert s.status is Status.SOLVED
    assert kkt_residuals(qp, s).worst <= 5e-8
    assert steps
    for step in steps:
        assert (step.ub == qp.ub).all()
        assert step.g == pytest.approx(P @ step.x + qp.q, abs=1e-6 * abs(step.g).max())


def test_fields_of_a_subclass_are_options():
    assert options_of(WithM())["inverse"] is None
    assert options_of(WithM())["expansion"] == "model"
