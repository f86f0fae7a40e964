"""The sparse approximate inverse of a dense P, on faces whose inverse is known."""

import numpy as np
import pytest

from mortarbench.harness import QP, Status, no_rows
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.solvers.smalbe.compiled import ApproximateInverse, Product
from mortarbench.solvers.smalbe.solver import SMALBE

NEIGHBOURS = 6


def on_face(F, free):
    """Return M restricted to the free components, and whether it is accurate."""
    M = ApproximateInverse(Product(F, len(F)))
    columns, accurate = [], True
    for j in np.flatnonzero(free):
        column, accurate = M.times(free, np.eye(len(F))[j])
        columns.append(column)
    return np.array(columns)[:, free], accurate


def chain(n, rng):
    """Draw sᵢ sⱼ exp(−|tᵢ − tⱼ|); each block of it has a tridiagonal inverse."""
    t, s = np.cumsum(rng.uniform(0.1, 1, n)), 10 ** rng.uniform(-3, 3, n)
    return np.outer(s, s) * np.exp(-np.abs(t[:, None] - t))


def random(n, spectrum, rng):
    Q = np.linalg.qr(rng.standard_normal((n, n)))[0]
    return (Q * spectrum) @ Q.T


@pytest.mark.parametrize("seed", range(10))
def test_a_tridiagonal_inverse_is_exact_on_every_face(seed):
    rng = np.random.default_rng(seed)
    F, free = chain(40, rng), rng.random(40) < 0.6

    M, accurate = on_face(F, free)

    block = F[np.ix_(free, free)]
    scale = np.sqrt(np.diag(block))
    assert accurate
    assert M * np.outer(scale, scale) == pytest.approx(
        np.linalg.inv(block / np.outer(scale, scale)), abs=1e-9
    )


def test_rows_are_recomputed_when_a_neighbour_leaves_the_face():
    rng = np.random.default_rng(5)
    F = chain(40, rng)
    M, free = ApproximateInverse(Product(F, 40)), np.ones(40, dtype=bool)
    for leaving in rng.permutation(40)[:30]:
        M.times(free, np.zeros(40))
        free[leaving] = False
        v = np.where(free, rng.standard_normal(40) / np.sqrt(np.diag(F)), 0)

        answer = M.times(free, v)[0]

        exact = np.linalg.solve(F[np.ix_(free, free)], v[free])
        assert answer[free] == pytest.approx(exact, rel=1e-6)
        assert not answer[~free].any()


@pytest.mark.parametrize("n", range(1, NEIGHBOURS + 2))
def test_few_components_are_inverted_exactly(n):
    rng = np.random.default_rng(n)
    F = random(n, rng.uniform(0.5, 2, n), rng)

    M, _ = on_face(F, np.ones(n, dtype=bool))

    assert M == pytest.approx(np.linalg.inv(F), rel=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_gfgt_has_a_unit_diagonal(seed):
    """Therefore, trace(MF) is the number of free components."""
    rng = np.random.default_rng(seed)
    F, free = random(60, rng.uniform(0.5, 2, 60), rng), rng.random(60) < 0.7

    M, _ = on_face(F, free)

    assert np.trace(M @ F[np.ix_(free, free)]) == pytest.approx(free.sum())
    assert np.linalg.eigvalsh(M).min() > 0


@pytest.mark.parametrize(
    "spectrum", [np.logspace(0, -12, 60), np.where(np.arange(60) < 20, 1.0, 0.0)]
)
def test_matrices_without_near_neighbours_are_recognised(spectrum):
    F = random(60, spectrum, np.random.default_rng(2))

    M, accurate = on_face(F, np.ones(60, dtype=bool))

    assert not accurate
    assert np.isfinite(M).all()


def test_a_face_of_few_components_does_not_hide_a_poor_inverse():
    F = random(60, np.logspace(0, -12, 60), np.random.default_rng(2))
    M = ApproximateInverse(Product(F, 60))

    assert M.times(np.arange(60) < 4, np.zeros(60))[1]
    assert not M.times(np.ones(60, dtype=bool), np.zeros(60))[1]


def test_without_curvature_the_model_is_used():
    """A component with Fᵢᵢ = 0 has no row of G, but still reaches its bound."""
    F = chain(30, np.random.default_rng(1))
    F[7] = F[:, 7] = 0.0
    x = np.where(np.arange(30) % 3, 1.0, 0.0)
    x[7] = 0.0
    z = np.where(x == 0, -1.0, 0.0)
    qp = QP(
        P=F, q=-(F @ x + z), A=no_rows(30), b=np.zeros(0), G=no_rows(30),
        h=np.zeros(0), lb=np.zeros(30), ub=np.full(30, np.inf),
    )  # fmt: skip

    s = SMALBE().prepare(qp, 1e-8)()

    assert not ApproximateInverse(Product(F, 30)).times(np.ones(30), np.zeros(30))[1]
    assert s.status is Status.SOLVED
    assert kkt_residuals(qp, s).worst <= 1e-7
