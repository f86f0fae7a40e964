"""Spectral projected gradients: iterates, counters, invariance."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.linalg import aslinearoperator

from mortarbench.harness import QP, Status
from mortarbench.solvers.baselines.projected_gradient import ProjectedGradient


def solve(qp, tol=1e-9):
    return ProjectedGradient().prepare(qp, tol)()


def random(seed, n=30):
    rng = np.random.default_rng(seed)
    W = rng.standard_normal((n, n))
    return QP.from_arrays(W @ W.T / n, rng.standard_normal(n), lb=0.0, ub=1.0)


def test_the_first_step_is_that_of_the_exact_line_search():
    """For P = cI, one step of length 1/c reaches the minimiser."""
    s = solve(QP.from_arrays(7 * np.eye(3), [1.0, -2, 3]))

    assert s.x == pytest.approx([-1 / 7, 2 / 7, -3 / 7], rel=1e-12)
    assert s.iterations == 1


def test_the_lengths_are_those_of_barzilai_and_borwein():
    """Without bounds, every length is the Cauchy length of the previous gradient."""
    P, g, x = np.diag([1.0, 4]), np.array([1.0, 4]), np.zeros(2)
    qp = QP.from_arrays(P, g)
    length = g @ g / (g @ P @ g)
    for _ in range(4):
        previous = g
        x = x - length * g
        g = g - length * P @ g
        length = previous @ previous / (previous @ P @ previous)

    s = ProjectedGradient(max_iter=4).prepare(qp, 1e-12)()

    assert s.status is Status.ITERATION_LIMIT
    assert s.message == "step limit"
    assert s.counts["shortened"] == 0
    assert s.x == pytest.approx(x, rel=1e-12)


def test_the_cost_never_rises_above_the_last_ones():
    """With a memory of one, the cost does not increase in any step, up to rounding."""
    qp = random(271828)
    costs = [
        qp.objective(ProjectedGradient(memory=1, max_iter=k).prepare(qp, 1e-12)().x)
        for k in range(1, 40)
    ]
    assert (np.diff(costs) < 1e-12).all()


def test_every_product_is_counted_and_one_per_step():
    qp = random(271828)
    products = []

    class Counting:
        shape, dtype = qp.P.shape, qp.P.dtype

        def __matmul__(self, v):
            products.append(v)
            return qp.P @ v

    s = solve(replace(qp, P=Counting()), 1e-6)

    assert s.status is Status.SOLVED
    assert s.counts["P_products"] == len(products)
    # two for the start, two for the residuals
    assert s.counts["P_products"] == s.iterations + 4


def test_operators_are_accepted_and_rows_are_declined(manufactured):
    qp = random(161803)
    as_operator = solve(replace(qp, P=aslinearoperator(csr_array(qp.P))))

    assert as_operator.x == pytest.approx(solve(qp).x, abs=1e-8)
    assert (
        ProjectedGradient().declines(manufactured("equalities")[0])
        == "accepts bounds, discs and cones, but no rows"
    )
    assert (
        ProjectedGradient().declines(manufactured("inequalities")[0])
        == "accepts bounds, discs and cones, but no rows"
    )


def test_an_unbounded_objective_is_reported():
    s = solve(QP.from_arrays([[1, 0], [0, 0]], [1.0, -1], lb=0.0))

    assert s.status is Status.UNBOUNDED
    assert "unbounded below" in s.message
