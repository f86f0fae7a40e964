"""Computed multipliers, at planted KKT points and at other points."""

import numpy as np
import pytest

from mortarbench.harness import QP, Cones, InputError
from mortarbench.harness.conformance.manufactured import (
    SET_SHAPES,
    manufactured_over_sets,
)
from mortarbench.harness.verify import multipliers
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.harness.verify.multipliers import with_multipliers

TOL = 1e-8
#: numbers of random QPs
SEARCHED = (20, pytest.param(200, marks=pytest.mark.slow))


def solved_qp(seed, *, definite=True):
    """Return a QP with redundant and degenerate rows, and its exact solution x.

    Depending on the seed, the QP has dependent equality rows, active inequality rows
    with and without a multiplier, duplicated rows, bounds on either side, fixed
    variables and free variables.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 30))
    L = rng.standard_normal((n, int(rng.integers(1, n + 1))))
    P = L @ L.T + definite * np.eye(n)
    x = rng.standard_normal(n)
    A = rng.standard_normal((int(rng.integers(0, n // 2 + 1)), n))
    if len(A):
        A = np.vstack([A, 3 * A[:1], A.sum(axis=0)])
    G = rng.standard_normal((int(rng.integers(0, 2 * n)), n))
    if len(G):
        G = np.vstack([G, 2 * G[:1]])
    is_active, bears = rng.random(len(G)) < 0.5, rng.random(len(G)) < 0.7
    z = np.where(is_active & bears, rng.exponential(size=len(G)), 0)
    slack = np.where(is_active, 0, rng.exponential(size=len(G)))
    lb, ub, z_box = np.full(n, -np.inf), np.full(n, np.inf), np.zeros(n)
    at = rng.integers(0, 6, n)
    force = rng.exponential(size=n) * (rng.random(n) < 0.7)
    lb[at == 0], z_box[at == 0] = x[at == 0], -force[at == 0]
    ub[at == 1], z_box[at == 1] = x[at == 1], force[at == 1]
    lb[at == 2], ub[at == 2] = x[at == 2] - 1, x[at == 2] + 1
    fixed = (at == 3) & (rng.random(n) < 0.3)
    lb[fixed] = ub[fixed] = x[fixed]
    z_box[fixed] = force[fixed] - 0.5
    y = rng.standard_normal(len(A))
    q = -(P @ x + A.T @ y + G.T @ z + z_box)
    return QP.from_arrays(P, q, G, G @ x + slack, A, A @ x, lb, ub), x


@pytest.mark.parametrize("definite", [True, False])
@pytest.mark.parametrize("count", SEARCHED)
def test_a_solution_without_multipliers_is_proven(count, definite):
    worst = [
        kkt_residuals(qp, with_multipliers(qp, x)).worst
        for qp, x in (solved_qp(seed, definite=definite) for seed in range(count))
    ]

    assert max(worst) <= 1e-13


@pytest.mark.parametrize("count", SEARCHED)
def test_a_point_beside_the_solution_has_no_multipliers(count):
    """With an error of 100·tol·max|xᵢ| in every component, a residual exceeds 10·tol.

    The QP is strictly convex, so no multipliers verify this point.
    """
    left = []
    for seed in range(count):
        qp, x = solved_qp(seed)
        off = np.random.default_rng(seed).choice([-1.0, 1.0], x.size)
        beside = x + 100 * TOL * np.abs(x).max() * off
        left.append(kkt_residuals(qp, with_multipliers(qp, beside)).worst)

    assert min(left) > 10 * TOL


def test_a_vertex_of_a_linear_program_with_more_rows_than_it_needs_is_proven():
    """For min −x₁ − x₂ over x ≤ 1, x₁ + x₂ ≤ 2, 2x₁ + x₂ ≤ 3, four rows
    and two bounds meet at (1, 1).
    """
    G = np.array([[1, 0], [0, 1], [1, 1], [2, 1]])
    qp = QP.from_arrays(np.zeros((2, 2)), [-1, -1], G, [1, 1, 2, 3], ub=1)
    x = np.ones(2)

    assert kkt_residuals(qp, with_multipliers(qp, x)).worst <= 1e-15
    assert kkt_residuals(qp, with_multipliers(qp, x - [0.1, 0])).worst > 1e-3


def test_passed_multipliers_are_unchanged():
    """One of two equal rows has a given multiplier; the other gets the remainder."""
    qp = QP.from_arrays([[1.0]], [-3.0], G=[[1.0]], h=[1.0], ub=[1.0])
    one = np.array([1.0])
    s = with_multipliers(qp, one, z=np.array([0.5]))

    assert (s.z.tolist(), s.z_box.tolist()) == ([0.5], [1.5])
    assert kkt_residuals(qp, s).worst == 0


def test_too_many_multipliers_are_refused(monkeypatch):
    monkeypatch.setattr(multipliers, "MAX_COLUMNS", 3)
    qp = QP.from_arrays(np.eye(4), -np.ones(4), np.eye(4), np.zeros(4))
    with pytest.raises(
        InputError, match=r"too many to compute; expected y, z and z_box"
    ):
        with_multipliers(qp, np.zeros(4))


INTEGERS = QP.from_arrays(
    P=[[4, 6, -4], [6, 9, -6], [-4, -6, 4]], q=[52, 45, -34],
    A=[[-2, 1, 0], [1, -1, -2]], b=[4, 0], G=[[-2, 2, -1]], h=[0],
    lb=[-np.inf, -4, 0], ub=[-4, -4, np.inf],
)  # fmt: skip
CROSSING = QP.from_arrays(
    np.zeros((2, 2)), [-1, -2], A=[[1, 1], [1, -1]], b=[2, 0], lb=[1, 1], ub=[1, 1]
)


@pytest.mark.parametrize(("qp", "x"), [(INTEGERS, [-4, -4, 0]), (CROSSING, [1, 1])])
def test_more_active_constraints_than_variables_have_moderate_multipliers(qp, x):
    """Least squares without a rank threshold return multipliers of 5e16."""
    s = with_multipliers(qp, np.array(x, dtype=float))

    assert kkt_residuals(qp, s).worst <= 1e-14
    assert max(np.abs(v).max(initial=0) for v in (s.y, s.z, s.z_box)) <= 100


@pytest.mark.parametrize("shape", SET_SHAPES)
def test_solutions_over_discs_and_cones_are_proven(shape):
    for seed in range(5):
        qp, planted = manufactured_over_sets(shape, seed=seed)
        assert kkt_residuals(qp, with_multipliers(qp, planted.x)).worst <= 1e-9


def qp_at_apexes(seed, rows, along):
    """Return a QP over cones, most of them at their apex, and its solution.

    along : True for forces on the boundary of the polar cone, False for its interior
    """
    rng = np.random.default_rng(seed)
    k = int(rng.integers(1, 6))
    index, slope = rng.permutation(3 * k).reshape(k, 3), rng.uniform(0.2, 1, k)
    t = rng.standard_normal((k, 2))
    t /= np.linalg.norm(t, axis=1)[:, None]
    x, z, pull = np.zeros(3 * k), np.zeros(3 * k), rng.uniform(0.5, 2, k)[:, None]
    slips = rng.integers(0, 3, k) == 0
    x[index] = np.column_stack([np.ones(k), slope[:, None] * t]) * slips[:, None]
    depth = slope * np.where(slips | along, 1, 2)
    z[index] = np.column_stack([-depth, t]) * pull
    W, A = rng.standard_normal((3 * k, 3 * k)), rng.standard_normal((rows, 3 * k))
    P = W @ W.T / x.size + 0.1 * np.eye(x.size)
    q = -(P @ x + A.T @ rng.standard_normal(rows) + z)
    stated = dict(A=A, b=A @ x) if rows else {}
    return QP.from_arrays(P, q, sets=[Cones(index, slope)], **stated), x


@pytest.mark.parametrize("count", [5, pytest.param(60, marks=pytest.mark.slow)])
@pytest.mark.parametrize("along", [False, True])
@pytest.mark.parametrize("rows", [0, 2])
def test_forces_at_the_apex_of_cones_are_found(rows, along, count):
    """Forces on the boundary of the polar cone have one direction of friction.

    Together with rows, the directions of some cones converge slowly.
    """
    worst = [
        kkt_residuals(qp, with_multipliers(qp, x)).worst
        for qp, x in (qp_at_apexes(seed, rows, along) for seed in range(count))
    ]

    assert np.quantile(worst, 0.9) <= (1e-9 if rows and along else 1e-12)
    assert np.mean(np.array(worst) <= 10 * TOL) >= 0.95
