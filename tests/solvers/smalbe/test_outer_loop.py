"""The outer loop of SMALBE: stopping criteria, and behaviour if no progress is
possible.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from mortarbench.harness import QP, Discs, Status, no_rows
from mortarbench.solvers.smalbe import driver
from mortarbench.solvers.smalbe.infeasibility import infeasible
from mortarbench.solvers.smalbe.projected import (
    by_lanczos,
    projected_problem,
)
from mortarbench.solvers.smalbe.rows import orthonormal_rows
from mortarbench.solvers.smalbe.solver import SMALBE


def drawn(seed, n=60, condition=1e3):
    """Draw a QP with bounds on the second half, two equality rows, and eigenvalues from
    1 to 1/condition.
    """
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.standard_normal((n, n)))[0]
    P = Q * np.geomspace(1, 1 / condition, n) @ Q.T
    P = (P + P.T) / 2
    q, A, x = P @ rng.standard_normal(n), rng.standard_normal((2, n)), rng.random(n)
    return QP(
        P=P, q=q, A=A, b=A @ x, G=no_rows(n), h=np.zeros(0),
        lb=np.where(np.arange(n) < n // 2, -np.inf, 0.0), ub=np.full(n, np.inf),
    )  # fmt: skip


@pytest.fixture
def outer_loop():
    """Return a function that runs the loop from x with a penalty that is
    far too small.
    """

    def run(problem, x, *, tol, max_steps=20_000, at=None):
        options = SMALBE(preconditioner="none", max_steps=max_steps or 1, recycle=False)
        object.__setattr__(options, "max_steps", max_steps)
        chosen = driver.outer_loop(problem, None, options)
        zero = np.zeros(len(problem.rows.C))
        return chosen.solve(tol, at or chosen.first(x, zero, M=1.0, rho=0.1))

    return run


def problem_of(qp):
    return projected_problem(qp, partial(by_lanczos, steps=10))


def test_the_accuracy_of_an_answer_does_not_depend_on_the_starting_point(outer_loop):
    """The tolerance is relative to b and not to the initial gradient, which is already
    small here.
    """
    free = dict(A=no_rows(60), b=np.zeros(0), lb=np.full(60, -np.inf))
    problem = problem_of(replace(drawn(271828), **free))
    near = outer_loop(problem, np.zeros(60), tol=1e-8)
    again = outer_loop(problem, problem.rows.x_tilde + near.nu, tol=1e-6)

    assert near.status is again.status is Status.SOLVED
    assert len(near.steps) > 20
    assert again.steps == ""


@pytest.mark.parametrize("most", [0, 1, 5, 20])
def test_steps_and_outer_iterations_end_at_their_limit(outer_loop, most):
    found = outer_loop(
        problem_of(drawn(271828)), np.zeros(60), tol=1e-8, max_steps=most
    )

    assert found.status is Status.ITERATION_LIMIT
    assert len(found.steps) + len(found.outer) <= most + 1


def test_a_continued_run_has_the_remaining_step_limit(outer_loop):
    problem = problem_of(drawn(271828))
    at = outer_loop(problem, np.zeros(60), tol=1e-8, max_steps=10)
    again = outer_loop(problem, np.zeros(60), tol=1e-8, max_steps=15, at=at)

    assert len(at.steps) + len(at.outer) <= 11
    assert again.status is Status.ITERATION_LIMIT
    assert len(again.steps) + len(again.outer) <= 16


@pytest.mark.parametrize("most", [1, 5, 20])
def test_the_lagrangian_is_that_of_the_point(outer_loop, most):
    """L = ½νᵀHν − bᵀν + μᵀCν; the last inner run is not followed by an update of μ."""
    problem = problem_of(drawn(314159))
    at = outer_loop(problem, np.zeros(60), tol=1e-8, max_steps=most)
    Cnu, rho = problem.rows.C @ at.nu, at.outer[-1].rho
    project = problem.rows.project
    A_nu = project(problem.F(project(at.nu))) / problem.spectrum.norm
    L = 0.5 * (at.nu @ A_nu + rho * Cnu @ Cnu) - problem.b @ at.nu + at.mu @ Cnu

    assert at.outer[-1].lagrangian == pytest.approx(L, rel=1e-10)


@pytest.mark.parametrize("unit", [2.0**-40, 1.0, 2.0**40])
@pytest.mark.parametrize("seed", range(3))
def test_infeasible_boxes_are_detected_beyond_rounding_in_every_unit(seed, unit):
    """The constraints are x ≥ lb and a positive row whose right-hand side is attained
    only at x = lb, or not at all.
    """
    rng = np.random.default_rng(seed)
    A, lb = rng.uniform(0.1, 1, (1, 6)), rng.uniform(1, 2, 6)

    def told(b):
        rows = orthonormal_rows(A, unit * b)
        nu = unit * lb - rows.x_tilde
        return infeasible(rows, (nu, np.full(6, np.inf)), nu)

    assert not told(A @ lb)
    assert told((1 - 1e-6) * (A @ lb))


@pytest.mark.parametrize("unit", [2.0**-40, 1.0, 2.0**40])
def test_a_distant_feasible_point_is_detected_in_every_unit(unit):
    """(2, −1000) satisfies x₁ + x₂/1000 = 1; x₂ has no bound."""
    rows = orthonormal_rows(np.array([[1.0, 1e-3]]), np.array([unit]))
    bounds = (unit * np.array([2.0, -np.inf]) - rows.x_tilde, np.full(2, np.inf))

    assert not infeasible(rows, bounds, unit * np.array([2.0, 0.0]) - rows.x_tilde)


def test_the_box_around_discs_is_that_of_x_shifted_by_a_point_of_the_rows():
    qp = QP.from_arrays(
        np.eye(3), np.ones(3), A=np.ones((1, 3)), b=3, lb=[-np.inf, -np.inf, 0],
        sets=[Discs([[0, 1]], [2])],
    )  # fmt: skip
    problem = problem_of(qp)
    lower, upper = (bound + problem.rows.x_tilde for bound in problem.hull)

    assert lower == pytest.approx([-2, -2, 0])
    assert upper == pytest.approx([2, 2, np.inf])
