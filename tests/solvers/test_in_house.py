"""In-house solvers on degenerate, infeasible and scaled QPs with known solutions."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array

from mortarbench.harness import QP, Status
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.solvers import SOLVERS
from tests.support.small_qps import floating_dual

SMALBES = [name for name in SOLVERS if name.startswith("smalbe")]
NAMES = [*SMALBES, "pdas", "projected-gradient"]
INF = np.inf


def solved(name, qp, tol=1e-10):
    """Solve a QP, or skip the test if the solver declines it."""
    solver = SOLVERS[name]
    if reason := solver.declines(qp):
        pytest.skip(reason)
    return solver.prepare(qp, tol)()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("store", [np.asarray, csr_array], ids=["dense", "sparse"])
@pytest.mark.parametrize(
    ("arrays", "x"),
    [
        (dict(P=[[1]], q=[-10], lb=0, ub=1), [1]),
        (dict(P=np.eye(3), q=np.zeros(3), lb=0), [0, 0, 0]),
        (dict(P=np.eye(3), q=np.ones(3), lb=0), [0, 0, 0]),
        (dict(P=np.eye(3), q=-np.ones(3), lb=0), [1, 1, 1]),
        (dict(P=np.eye(3), q=np.zeros(3), lb=[1, -1, -INF]), [1, 0, 0]),
        (dict(P=np.eye(2), q=[5, -1], lb=[2, -9], ub=[2, 9]), [2, 1]),
        (dict(P=np.eye(2), q=[5, -1], lb=[2, 3], ub=[2, 3]), [2, 3]),
        # an iterate has more active bounds than the row permits
        (dict(P=np.eye(2), q=[1, 1], A=[[1, 1]], b=[4], lb=0), [2, 2]),
        # the shortest solution of the row, (0.2, −0.6), lies outside the bounds
        (dict(P=np.diag([1, 4]), q=[0, 0], A=[[1, -3]], b=[2], lb=0), [2, 0]),
        # the solution of the row is a corner
        (dict(P=np.eye(2), q=[1, 1], A=[[1, -1]], b=[0], lb=0), [0, 0]),
        # singular P: x₂ is at its bound, because its gradient is 1
        (dict(P=[[1, 0], [0, 0]], q=[-1, 1], lb=-3), [1, -3]),
        (dict(P=np.zeros((2, 2)), q=[1, 2], A=[[1, 1]], b=[1], lb=0), [1, 0]),
    ],
    ids=["two-sided", "q = 0", "all active", "none active", "shifted bound", "fixed",
         "all fixed", "row", "far row", "corner", "singular", "linear"],
)  # fmt: skip
def test_degenerate_problems_have_their_solutions(name, arrays, x, store):
    qp = QP.from_arrays(**arrays | {"P": store(np.array(arrays["P"], dtype=float))})
    s = solved(name, qp)

    assert s.status is Status.SOLVED
    assert s.x == pytest.approx(x, abs=1e-8)
    assert kkt_residuals(qp, s).worst <= 1e-9


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "qp",
    [
        QP.from_arrays(np.eye(3), np.ones(3), A=[[1, 1, 0], [2, 2, 0]], b=[1, 3]),
        QP.from_arrays(np.eye(2), [1, 1], A=[[1, 1]], b=[5], lb=0, ub=1),
        QP.from_arrays(np.eye(2), [1, 1], A=[[1, 1]], b=[-1], lb=0),
        QP.from_arrays(np.eye(2), [0, 0], A=[[1, 1]], b=[-1], lb=0),
        QP.from_arrays(np.eye(3), [0, 1, 0], A=np.eye(3), b=[1, -1, 3], lb=0),
        QP.from_arrays(np.eye(3), np.ones(3), A=[[1, 2, 3]], b=[7], lb=1, ub=1),
        QP.from_arrays(np.eye(2), [0, 0], G=[[1, -1], [-1, 1]], h=[-1, -1]),
    ],
    ids=["rows", "box", "half space", "q = 0", "rows are bounds", "all fixed",
         "inequalities"],
)  # fmt: skip
def test_problems_without_a_feasible_point_are_reported(name, qp):
    s = solved(name, qp, 1e-6)

    assert s.status is Status.INFEASIBLE
    assert np.isnan(s.x).all()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("exponent", [-30, 30])
def test_scaling_the_objective_changes_no_step(name, exponent):
    """The factor is a power of two, so that the arithmetic is exact."""
    rng, factor = np.random.default_rng(314159), 2.0**exponent
    W = rng.standard_normal((30, 28))
    qp = QP.from_arrays(W @ W.T / 30, rng.standard_normal(30), lb=0, ub=1)
    plain, scaled = (
        solved(name, p, 1e-8)
        for p in (qp, replace(qp, P=qp.P * factor, q=qp.q * factor))
    )

    assert scaled.counts == plain.counts
    assert (scaled.x == plain.x).all()


@pytest.mark.parametrize("seed", [271828, 314159, 161803])
@pytest.mark.parametrize("tol", [1e-3, 1e-6, 1e-10])
@pytest.mark.parametrize("name", NAMES)
def test_duals_of_floating_bodies_are_solved(name, seed, tol):
    qp = floating_dual(seed)
    s = solved(name, qp, tol)

    assert s.status is Status.SOLVED
    assert kkt_residuals(qp, s).worst <= 10 * tol


@pytest.mark.parametrize("name", ["smalbe", "pdas"])
@pytest.mark.parametrize("seed", [271828, 314159])
def test_scaled_repeated_and_zero_rows_change_no_answer(name, seed):
    qp = floating_dual(seed)
    A, b = qp.A, qp.b
    rows = np.vstack([1e6 * A[0], A[1], 1e-6 * A[2], A.sum(axis=0), 0 * A[0]])
    e = np.array([1e6 * b[0], b[1], 1e-6 * b[2], b.sum(), 0.0])
    plain, mixed = (solved(name, one) for one in (qp, replace(qp, A=rows, b=e)))

    assert mixed.status is Status.SOLVED
    assert qp.objective(mixed.x) == pytest.approx(qp.objective(plain.x), rel=1e-8)
    assert rows.T @ mixed.y == pytest.approx(A.T @ plain.y, abs=1e-7)
