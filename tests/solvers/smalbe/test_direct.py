"""SMALBE with exact solutions on faces: solutions, steps and declined problems."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from mortarbench.harness import QP, Status, no_rows
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.smalbe.direct import MAX_UNKNOWNS
from mortarbench.solvers.smalbe.faces import Faces

DIRECT = SOLVERS["smalbe-direct"]


def box_qp(P, q, lb=-np.inf, ub=np.inf, A=None, b=()):
    n = len(q)
    lb, ub = np.broadcast_to(lb, n), np.broadcast_to(ub, n)
    return QP(
        P=np.asarray(P, float), q=np.asarray(q, float),
        A=no_rows(n) if A is None else np.asarray(A, float), b=np.asarray(b, float),
        G=no_rows(n), h=np.zeros(0), lb=lb, ub=ub,
    )  # fmt: skip


def solved(qp, tol=1e-10):
    s = DIRECT.prepare(qp, tol)()
    assert s.status is Status.SOLVED, s.message
    assert kkt_residuals(qp, s).worst <= 5 * tol
    return s


def with_solution(seed, n, m, rank):
    """Draw a KKT point and a QP with this solution, with two-sided, one-sided
    or no bounds.
    """
    rng = np.random.default_rng(seed)
    W = rng.standard_normal((n, rank))
    side = rng.choice([-1, 0, 1], n)
    x, room = rng.standard_normal(n), rng.exponential(size=n)
    lb = np.where(side < 0, x, np.where(rng.random(n) < 0.5, x - room, -np.inf))
    ub = np.where(side > 0, x, np.where(rng.random(n) < 0.5, x + room, np.inf))
    z, y = side * rng.exponential(size=n), rng.standard_normal(m)
    A = rng.standard_normal((m, n))
    return box_qp(W @ W.T, -(W @ (W.T @ x) + A.T @ y + z), lb, ub, A, A @ x), x


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize(("n", "m"), [(1, 0), (8, 2), (40, 5), (150, 0), (150, 6)])
def test_a_known_solution_is_found(seed, n, m):
    qp, x = with_solution(seed, n, m, rank=n + 5)

    assert solved(qp).x == pytest.approx(x, abs=1e-6)


@pytest.mark.parametrize("seed", range(12))
def test_a_singular_P_leaves_no_residual(seed):
    """The null space has a third of the dimensions, so the minimiser may
    not be unique.
    """
    solved(with_solution(seed, 30, 3, rank=20)[0], 1e-8)


@pytest.mark.parametrize("store", [np.asfortranarray, csr_array])
def test_P_may_be_stored_in_any_way(store):
    qp, x = with_solution(5, 20, 2, rank=25)
    stored = box_qp(qp.P, qp.q, qp.lb, qp.ub, qp.A, qp.b)
    object.__setattr__(stored, "P", store(qp.P))

    assert solved(stored).x == pytest.approx(x, abs=1e-6)


def test_a_linear_cost_ends_in_a_vertex():
    """The minimiser of −x₁ − 2x₂ over x₁ + x₂ = 3, 0 ≤ x ≤ 2 is (1, 2)."""
    qp = box_qp(np.zeros((2, 2)), [-1, -2], 0, 2, [[1, 1]], [3])

    assert solved(qp, 1e-8).x == pytest.approx([1, 2], abs=1e-9)


def test_an_upper_bound_stops_a_component_that_a_lower_one_released():
    """For ½x² − 10x on [0, 1], PERMON's proportioning step would end at 10."""
    s = solved(box_qp([[1]], [-10], 0, 1))

    assert s.x == pytest.approx([1])
    assert s.z_box == pytest.approx([9])


def test_components_with_one_gradient_are_released_together():
    """The solution is x = (1, 1, 1, 0, …): the first factor has no rows, the second one
    has three.
    """
    q = np.r_[-np.ones(3), np.ones(5)]
    s = solved(box_qp(np.eye(8), q, 0), 1e-8)

    assert s.x == pytest.approx(np.maximum(-q, 0))
    assert (s.counts["solves"], s.counts["set_changes"]) == (2, 3)


def test_a_smaller_gradient_waits_for_the_larger_one():
    """The components with gradients 4, 1 and 0.3 are released one after another,
    because each gradient is less than 0.45 times its predecessor.
    """
    s = solved(box_qp(np.eye(3), [-4, -1, -0.3], 0), 1e-8)

    assert s.x == pytest.approx([4, 1, 0.3])
    assert (s.counts["solves"], s.counts["set_changes"]) == (4, 3)


@pytest.mark.parametrize("gone", [1, 2, 40, 79])
def test_rows_leave_the_factor_by_rotations_or_a_new_one(gone):
    """The free minimum of the first `gone` components is −5, below their bound −1."""
    n = 80
    rng = np.random.default_rng(gone)
    W = rng.standard_normal((n, n)) / np.sqrt(n)
    P = np.eye(n) + 0.01 * (W @ W.T)
    wish = np.where(np.arange(n) < gone, -5.0, 5.0)
    bounds = np.where(wish < 0, -1.0, -np.inf), np.full(n, np.inf)
    no_rows = np.zeros((0, n))
    faces = Faces(P, -(P @ wish), no_rows, np.zeros(n), bounds, 1.0, 1e-13)

    assert faces.minimise(100)
    x, Px, z = faces.at(np.zeros(0))
    assert faces.left >= gone
    assert np.flatnonzero(x == -1).tolist() == list(range(gone))
    assert Px - P @ wish + z == pytest.approx(np.zeros(n), abs=1e-11)
    assert (z[:gone] < 0).all()


def test_rows_that_contradict_each_other_are_infeasible():
    qp = box_qp(np.eye(2), [0, 0], A=[[1, 1], [1, 1]], b=[0, 1])

    assert DIRECT.prepare(qp, 1e-8)().status is Status.INFEASIBLE


def test_bounds_that_exclude_the_rows_are_infeasible():
    qp = box_qp(np.eye(3), [1, 2, 3], 0, 1, [[1, 1, 1]], [3.5])

    assert DIRECT.prepare(qp, 1e-8)().status is Status.INFEASIBLE


def test_no_success_is_claimed_without_a_minimum():
    falls = box_qp(np.zeros((2, 2)), [-1, 0], 0)
    bends = box_qp([[1, 2], [2, 1]], [0, 0])
    saddle = box_qp([[-1]], [0], -1, 1)

    assert DIRECT.prepare(falls, 1e-8)().status is Status.ITERATION_LIMIT
    assert DIRECT.prepare(bends, 1e-8)().status is Status.FAILED
    assert DIRECT.prepare(saddle, 1e-8)().status is Status.FAILED


def test_the_solver_stops_after_the_allowed_number_of_solves():
    qp, _ = with_solution(3, 40, 0, rank=45)
    s = type(DIRECT)(max_solves=1).prepare(qp, 1e-8)()

    assert s.status is Status.ITERATION_LIMIT
    assert s.message == "step limit"


def test_the_reason_for_declining_is_returned():
    n = MAX_UNKNOWNS + 1
    large = box_qp(csr_array((n, n)).toarray(), np.zeros(n), 0)
    rows = QP(
        P=np.eye(1), q=np.zeros(1), A=no_rows(1), b=np.zeros(0),
        G=csr_array([[1.0]]), h=np.ones(1), lb=np.zeros(1), ub=np.ones(1),
    )  # fmt: skip

    assert str(MAX_UNKNOWNS) in DIRECT.declines(large)
    assert "no inequality rows" in DIRECT.declines(rows)
    assert DIRECT.declines(box_qp(np.eye(2), [1, 1], 0)) is None
