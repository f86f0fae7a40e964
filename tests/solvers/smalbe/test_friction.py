"""SMALBE on duals with friction: two-sided bounds, sticking and slipping rows."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mortarbench.harness import Status
from mortarbench.harness.names import parse
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution

pytestmark = pytest.mark.together

TOL = 1e-8
PRESETS = ("smalbe-permon", "smalbe-espreso")
COULOMB = "friction=coulomb/mu=0.3"
CASES = [
    "greco/n=16/dual-bounds",
    "greco/n=16/dual",
    "half-plane/law=cattaneo/Q=0.6/dual",
    f"hertz-cylinder/n=5/m=5/{COULOMB}/Q=0.5/dual",
    f"beam-ring/Nr=4/Nh=3/steps=1/{COULOMB}/dual",
    "beam-ring/Nr=4/Nh=3/steps=1/friction=tresca/bound=1e8/dual-bounds",
]


@cache
def emitted(name):
    return parse(name, PROBLEMS).build(reference_solution).qp


def products(solutions):
    return sum(s.counts["P_products"] for s in solutions)


@pytest.mark.parametrize("name", CASES)
def test_friction_takes_fewer_products_than_published_rules(name):
    qp, exact = emitted(name), reference_solution(emitted(name))
    found = {s: SOLVERS[s].prepare(qp, TOL)() for s in ("smalbe", *PRESETS)}

    for s in found.values():
        assert s.status is Status.SOLVED
        assert kkt_residuals(qp, s).worst <= 10 * TOL
        assert s.x == pytest.approx(exact.x, abs=1e-4 * abs(exact.x).max())
    assert products([found["smalbe"]]) <= 0.85 * min(
        products([found[s]]) for s in PRESETS
    )


def test_all_slipping_rows_slip_back():
    """Warm-started steps go from one bound to the opposite one and back: the loads are
    Q, −Q, Q and −Q.
    """
    there = emitted("half-plane/law=cattaneo/Q=0.9/dual")
    back = replace(there, b=-there.b)
    prepare = SOLVERS["smalbe"].chain(TOL)
    found = [(qp, prepare(qp)()) for qp in (there, back, there, back)]
    cold = [SOLVERS["smalbe"].prepare(qp, TOL)() for qp, _ in found]

    for (qp, s), other in zip(found, cold, strict=True):
        assert kkt_residuals(qp, s).worst <= 10 * TOL
        assert s.x == pytest.approx(other.x, abs=1e-5 * abs(other.x).max())
    assert (np.sign(found[0][1].x) == -np.sign(found[1][1].x)).all()
    assert products([s for _, s in found]) <= 1.2 * products(cold)


def test_bounds_that_become_active_and_inactive_again_are_tracked():
    """Without friction, both bounds of every tangential multiplier are zero."""
    with_friction = emitted("greco/n=16/dual-bounds")
    without = replace(
        with_friction,
        lb=np.append(with_friction.lb[:16], np.zeros(16)),
        ub=np.append(with_friction.ub[:16], np.zeros(16)),
    )
    some = replace(
        with_friction,
        lb=np.where(np.arange(32) % 3, with_friction.lb, 0.0),
        ub=np.where((np.arange(32) % 3 > 0) | (np.arange(32) < 16),
                    with_friction.ub, 0.0),
    )  # fmt: skip
    prepare = SOLVERS["smalbe"].chain(TOL)

    for qp in (without, with_friction, some, without, some, with_friction):
        s = prepare(qp)()
        assert s.status is Status.SOLVED
        assert kkt_residuals(qp, s).worst <= 10 * TOL
        assert s.x == pytest.approx(reference_solution(qp).x, abs=1e-5 * abs(s.x).max())


def test_the_history_ends_with_the_rows_that_slip():
    """A history has the column `two_sided` only if a variable has two finite bounds."""
    qp = emitted("greco/n=16/dual-bounds")
    solver = replace(SOLVERS["smalbe"], history=True)
    s = solver.prepare(qp, TOL)()
    two = np.isfinite(qp.ub) & (qp.lb < qp.ub)
    at_bound = np.minimum(s.x - qp.lb, qp.ub - s.x) == 0

    assert s.history["two_sided"][-1] == (two & at_bound).sum() > 0
    assert s.history["active"][-1] == at_bound.sum()
    smooth = replace(qp, ub=np.full(qp.ub.size, np.inf))
    assert "two_sided" not in solver.prepare(smooth, TOL)().history


def fixed_point(qp, mu, solve, enough):
    """Solve Coulomb's law on a dual with bounds only; return all solutions in order."""
    m = qp.q.size // 2
    bound, found = np.zeros(m), []
    for _ in range(60):
        tresca = replace(
            qp, lb=np.append(np.zeros(m), -bound), ub=np.append(qp.ub[:m], bound)
        )
        found.append(solve(tresca))
        assert kkt_residuals(tresca, found[-1]).worst <= 10 * TOL
        demanded = mu * np.maximum(found[-1].x[:m], 0)
        residual = np.linalg.norm(bound - demanded) / max(np.linalg.norm(bound), 1e-300)
        if residual <= enough:
            return found, residual
        bound = demanded
    raise AssertionError(f"residual {residual} after 60 problems")


def test_a_warm_fixed_point_takes_about_half_the_products_of_a_cold_one():
    """Both sequences end at the same residual of Coulomb's law."""
    qp, solver, enough = emitted("greco/n=16/dual-bounds"), SOLVERS["smalbe"], 1e-7
    prepare = solver.chain(TOL)
    warm, left = fixed_point(qp, 1.0, lambda qp: prepare(qp)(), enough)
    cold, _ = fixed_point(qp, 1.0, lambda qp: solver.prepare(qp, TOL)(), enough)
    exact = reference_solution(qp)

    assert left <= enough
    assert abs(len(warm) - len(cold)) <= 1  # residuals differ by rounding
    assert products(warm) <= 0.55 * products(cold)
    assert warm[-1].x == pytest.approx(exact.x, abs=1e-5 * abs(exact.x).max())


def test_warm_starts_save_products_with_equality_rows():
    """The friction bounds approach those of Coulomb's law."""
    last = emitted(f"beam-ring/Nr=4/Nh=3/steps=1/{COULOMB}/dual")
    scale = np.where(np.isfinite(last.ub), last.ub, 0)
    qps = [
        replace(last, lb=last.lb + (1 - part) * scale, ub=last.ub - (1 - part) * scale)
        for part in (0, 0.5, 0.8, 0.9, 0.97, 0.99, 1)
    ]
    prepare = SOLVERS["smalbe"].chain(TOL)
    warm = [prepare(qp)() for qp in qps]
    cold = [SOLVERS["smalbe"].prepare(qp, TOL)() for qp in qps]

    for qp, s in zip(qps, warm, strict=True):
        assert kkt_residuals(qp, s).worst <= 10 * TOL
    assert products(warm) <= 0.63 * products(cold)


def test_a_sequence_with_one_equation_reuses_the_previous_spectrum():
    """The arrays that are passed to the next QP have the layout that the compiled code
    requires.
    """
    qp = emitted("half-plane/law=cattaneo/Q=0.6/dual")
    prepare = SOLVERS["smalbe"].chain(TOL)
    first, again = prepare(qp)(), prepare(qp)()

    assert qp.b.size == 1
    assert again.counts["P_products"] < 0.5 * first.counts["P_products"]
