"""Bounded least squares of SciPy: declined problems, exactness, limits."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.linalg import aslinearoperator

from mortarbench.harness import QP, Status, no_rows
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.solvers.baselines import bvls
from mortarbench.solvers.baselines.bvls import BVLS


def boxed(P, q, lb=-np.inf, ub=np.inf):
    P, q = np.asarray(P, dtype=float), np.asarray(q, dtype=float)
    lb, ub = (np.broadcast_to(v, q.size).astype(float) for v in (lb, ub))
    none = no_rows(q.size), np.zeros(0)
    return QP(P=P, q=q, A=none[0], b=none[1], G=none[0], h=none[1], lb=lb, ub=ub)


@pytest.mark.parametrize(
    ("qp", "x"),
    [
        (boxed([[1.0]], [-10.0], lb=0.0, ub=1.0), [1]),
        (boxed(np.eye(3), np.zeros(3), lb=0.0), [0, 0, 0]),
        (boxed(np.eye(3), np.zeros(3), lb=[1.0, -1, -np.inf]), [1, 0, 0]),
        (boxed(np.eye(3), np.ones(3), lb=0.0), [0, 0, 0]),
        (boxed(np.eye(3), -np.ones(3), lb=0.0), [1, 1, 1]),
        (boxed(np.eye(2), [5.0, -1], lb=[2.0, -9], ub=[2.0, 9]), [2, 1]),
        (boxed(np.eye(2), [5.0, -1], lb=[2.0, 3], ub=[2.0, 3]), [2, 3]),
        (boxed([[4, 2], [2, 3]], [-8.0, -7], ub=[np.inf, 1]), [1.5, 1]),
    ],
    ids=["two-sided", "q = 0", "q = 0, shifted bound", "all active", "none active",
         "fixed", "all fixed", "upper only"],
)  # fmt: skip
def test_degenerate_problems_have_their_solutions_exactly(qp, x):
    assert BVLS().declines(qp) is None
    s = BVLS().prepare(qp, 1e-3)()

    assert s.status is Status.SOLVED
    assert s.x == pytest.approx(x, abs=1e-14)
    assert kkt_residuals(qp, s).worst <= 1e-14


@pytest.mark.parametrize("exponent", [-30, 30])
def test_scaling_the_objective_changes_nothing(manufactured, exponent):
    for shape in ("bounds", "box"):
        qp, factor = manufactured(shape)[0], 2.0**exponent
        scaled = replace(qp, P=qp.P * factor, q=qp.q * factor)
        plain, large = (BVLS().prepare(p, 1e-9)() for p in (qp, scaled))
        assert large.iterations == plain.iterations
        assert large.x == pytest.approx(plain.x, rel=1e-12, abs=1e-14)


def test_qps_outside_its_scope_are_declined(manufactured, monkeypatch):
    qp, _ = manufactured("box")
    operator = replace(qp, P=aslinearoperator(qp.P))
    singular = replace(qp, P=csr_array(np.diag([0.0] + [1.0] * 19)))

    assert BVLS().declines(manufactured("equalities")[0]) == "accepts bounds only"
    assert BVLS().declines(operator) == "needs explicit matrices"
    assert BVLS().declines(singular) == "needs a positive definite P"
    monkeypatch.setattr(bvls, "MAX_COMPONENTS", 19)
    assert (
        BVLS().declines(qp)
        == "converts P to a dense matrix; accepts at most 19 components"
    )


@pytest.mark.parametrize("shape", ["bounds", "box"])
def test_the_step_limit_is_not_called_solved(manufactured, shape):
    qp, _ = manufactured(shape, n=60)
    s = BVLS(max_iter=1).prepare(qp, 1e-9)()

    assert s.status is Status.ITERATION_LIMIT
    assert s.message
