"""Search for QPs on which SMALBE makes a false claim or stops without a solution."""

from dataclasses import replace

import numpy as np
import pytest

from mortarbench.harness import QP, Status, no_rows
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.common.stopping import relative_residual

TOLERANCES = (1e-6, 1e-9, 1e-12)


def hostile(seed):
    """Draw a QP with a known KKT point: ill-conditioned, degenerate, of any scale.

    P is singular or has a condition number up to 1e10, about 30 % of the multipliers of
    active bounds are zero, and two rows may differ by only 1e-8. With a smaller
    difference, the rounding of b would make the QP infeasible.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 60))
    m = int(rng.integers(0, min(n, 5) + 1))
    Q = np.linalg.qr(rng.standard_normal((n, n)))[0]
    eigenvalues = np.logspace(0, -rng.uniform(0, 10), n)
    if rng.random() < 0.3:
        eigenvalues[rng.random(n) < 0.3] = 0
    P = (Q * eigenvalues) @ Q.T * 10 ** rng.uniform(-6, 6)
    P = (P + P.T) / 2
    size = 10 ** rng.uniform(-4, 4)
    x = size * rng.standard_normal(n)
    kind, active = rng.integers(0, 4, n), rng.random(n) < 0.4
    room = size * rng.exponential(size=(3, n))
    lb = np.where(kind == 1, x - room[0], np.where(kind == 3, x - size, -np.inf))
    lb = np.where(active, x, lb)
    ub = np.where(kind == 2, x + room[1], np.inf)
    scale = np.abs(P).max() * size
    degenerate = rng.random(n) < 0.3
    z = np.where(active & ~degenerate, -scale * room[2] / size, 0.0)
    A = rng.standard_normal((m, n))
    if m >= 2 and rng.random() < 0.4:
        A[-1] = A[0] + 10 ** rng.uniform(-8, -2) * rng.standard_normal(n)
    A *= 10 ** rng.uniform(-3, 3, (m, 1))
    y = rng.standard_normal(m) * scale / np.abs(A).max(initial=1e-3)
    return QP(
        P=P, q=-(P @ x + A.T @ y + z), A=A if m else no_rows(n), b=A @ x,
        G=no_rows(n), h=np.zeros(0), lb=lb, ub=ub,
    )  # fmt: skip


def ends(seeds, solver="smalbe"):
    """Return the numbers of runs without a solution and of all runs, and the false
    claims.
    """
    given_up, runs, wrong = 0, 0, []
    for seed in seeds:
        qp = hostile(seed)
        for tol in TOLERANCES:
            s = SOLVERS[solver].prepare(qp, tol)()
            runs += 1
            if s.status is not Status.SOLVED:
                given_up += s.status is Status.ITERATION_LIMIT
                wrong += [(seed, tol)] * (s.status is Status.INFEASIBLE)
            elif not kkt_residuals(qp, s).worst <= 10 * tol:
                wrong.append((seed, tol))
    return given_up, runs, wrong


def test_no_claim_is_wrong():
    given_up, runs, wrong = ends(range(1000, 1015))

    assert wrong == []
    assert given_up <= 0.02 * runs


@pytest.mark.parametrize("seed", [343, 0, 1])
def test_without_a_cost_any_feasible_point_is_found_optimal(seed):
    """The multipliers are then zero, and 1 is the scale of their errors."""
    qp = hostile(seed)
    qp = replace(qp, P=0 * qp.P, q=0 * qp.q)
    for tol in TOLERANCES:
        s = SOLVERS["smalbe"].prepare(qp, tol)()

        assert s.status is Status.SOLVED
        assert abs(qp.A.T @ s.y + s.z_box).max() <= tol
        assert (qp.lb <= s.x).all()
        assert (s.x <= qp.ub).all()
        assert relative_residual(qp, s, tol) <= tol


@pytest.mark.slow
def test_at_most_one_of_two_hundred_runs_fails():
    given_up, runs, wrong = ends(range(700))

    assert runs == 2100
    assert wrong == []
    assert given_up <= 0.005 * runs
