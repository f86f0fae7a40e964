"""The compiled SMALBE: its parts, and its answers compared with the textbook."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.sparse import csr_array

from mortarbench.harness import QP, Status, no_rows
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.common.stopping import relative_residual
from mortarbench.solvers.smalbe import compiled
from mortarbench.solvers.smalbe import rows as rows_module
from mortarbench.solvers.smalbe.driver import outer_loop
from mortarbench.solvers.smalbe.projected import by_lanczos, projected_problem
from mortarbench.solvers.smalbe.solver import SMALBE
from mortarbench.solvers.smalbe.textbook import Textbook

pytestmark = pytest.mark.together


class Operator:
    """A matrix that supports products only."""

    def __init__(self, P):
        self._P, self.shape = P, P.shape

    def __matmul__(self, v):
        return self._P @ v


def random_qp(seed, kind="dense"):
    """Draw a QP with lower, upper, two-sided or no bounds and up to three rows; three
    rows are linearly dependent.
    """
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 40)), int(rng.integers(0, 4))
    W = rng.standard_normal((n, n)) * np.logspace(0, -rng.uniform(0, 3), n)
    P = W @ W.T + 1e-3 * np.eye(n)
    inside = rng.standard_normal(n)
    lb = np.where(rng.random(n) < 0.6, inside - rng.exponential(size=n), -np.inf)
    ub = np.where(rng.random(n) < 0.3, inside + rng.exponential(size=n), np.inf)
    A = rng.standard_normal((min(m, n), n)) * 10 ** rng.uniform(-2, 2)
    if len(A) == 3:
        A[2] = A[0] - A[1]
    made = {"dense": P, "sparse": csr_array(P), "operator": Operator(P)}[kind]
    return QP(
        P=made, q=10 * rng.standard_normal(n), A=A if len(A) else no_rows(n),
        b=A @ inside, G=no_rows(n), h=np.zeros(0), lb=lb, ub=ub,
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("kind", ["dense", "sparse", "operator"])
def test_a_product_is_the_product_and_is_counted(seed, kind):
    qp = random_qp(seed, kind)
    v = np.random.default_rng(seed).standard_normal(qp.q.size)
    P = compiled.Product(qp.P, qp.q.size)

    assert P(v) == pytest.approx(qp.P @ v, rel=1e-12, abs=1e-12)
    P(v)
    assert P.count == 2


@pytest.mark.parametrize("offsets", [(), (1,), (1, 2), (1, 40), (3, 299), (1, 7, 8, 9)])
@pytest.mark.parametrize("n", [1, 5, 16, 300, 777])
def test_a_product_by_diagonals_is_the_product(offsets, n):
    """Rows near the ends lack some diagonals, and entries may be stored as
    two terms.
    """
    rng = np.random.default_rng([n, *offsets])
    P = np.diag(rng.standard_normal(n))
    for o in (o for o in offsets if o < n):
        part = np.diag(rng.standard_normal(n - o), o)
        P += part + part.T
    i, j = np.nonzero(P)
    twice = rng.permutation(np.r_[: i.size, : i.size])
    halves = csr_array((P[i, j][twice] / 2, (i[twice], j[twice])), shape=(n, n))
    told = csr_array((n, n))
    told.data = np.repeat(halves.data / 2, 2)
    told.indices, told.indptr = np.repeat(halves.indices, 2), 2 * halves.indptr
    v = rng.standard_normal(n)

    for M in (halves, told):
        assert compiled.Product(M, n)(v) == pytest.approx(P @ v, rel=1e-12, abs=1e-12)


def test_a_product_with_fewer_entries_than_rows():
    P = csr_array(([2.0, 2.0], ([0, 4], [4, 0])), shape=(5, 5))

    assert compiled.Product(P, 5)(np.arange(1.0, 6)).tolist() == [10, 0, 0, 0, 2]


def test_a_product_of_another_length_is_refused():
    class Short(Operator):
        def __matmul__(self, v):
            return (self._P @ v)[:-1]

    with pytest.raises(ValueError, match="4 components; expected 5"):
        compiled.Product(Short(np.eye(5)), 5)(np.ones(5))


@pytest.mark.parametrize("order", ["C", "F"])
def test_a_product_with_any_layout(order):
    W = np.random.default_rng(271828).standard_normal((17, 17))
    P = np.array(W + W.T, order=order)
    P.flags.writeable = False
    v = np.arange(17.0)

    assert compiled.Product(P, 17)(v) == pytest.approx(P @ v, rel=1e-13)
    half = P[::2, ::2]
    assert compiled.Product(half, 9)(v[:9]) == pytest.approx(half @ v[:9], rel=1e-13)


def prepared_problem(qp, steps):
    return projected_problem(qp, partial(by_lanczos, steps=steps))


@pytest.mark.parametrize("seed", range(10))
def test_the_preparation_projects_and_normalises(seed):
    """C spans the rows of A, x̃ is the shortest solution of Ax = b, and the norm is that
    of 𝒫P𝒫.
    """
    qp = random_qp(seed)
    A, problem = csr_array(qp.A).toarray(), prepared_problem(qp, 12)
    C, pseudo = problem.rows.C, np.linalg.pinv(A)
    project = np.eye(qp.q.size) - pseudo @ A
    a = np.arange(1.0, len(C) + 1)

    assert problem.rows.consistent
    assert C @ C.T == pytest.approx(np.eye(np.linalg.matrix_rank(A)), abs=1e-9)
    assert C.T @ C == pytest.approx(pseudo @ A, abs=1e-9)
    assert problem.rows.x_tilde == pytest.approx(pseudo @ qp.b, abs=1e-8)
    norm = np.linalg.norm(project @ qp.P @ project, 2)
    assert problem.spectrum.norm >= norm * (1 - 1e-9) or norm < 1e-9
    assert qp.A.T @ problem.rows.multipliers(a) == pytest.approx(C.T @ a, abs=1e-7)


@pytest.mark.parametrize("kind", ["dense", "sparse", "operator"])
@pytest.mark.parametrize("seed", range(4))
def test_answers_agree_with_the_textbook(seed, kind):
    same_answers(random_qp(seed, kind), SMALBE())


@pytest.mark.parametrize("seed", range(4))
def test_a_small_penalty_leads_to_the_answer_of_the_textbook(seed):
    """ρ is below the tail of the model."""
    same_answers(random_qp(seed), SMALBE(rho=1e-3))


def same_answers(qp, solver):
    """Compare x and the multipliers of bounds, which are unique, with the textbook."""
    fast, slow = (one.prepare(qp, 1e-10)() for one in (solver, Textbook()))

    assert fast.status is slow.status is Status.SOLVED
    for name in ("x", "z_box"):
        expected = getattr(slow, name)
        size = 1 + np.abs(expected).max()
        assert getattr(fast, name) == pytest.approx(expected, abs=1e-5 * size)


@pytest.mark.parametrize("preconditioner", ["model", "sparse", "none", "diagonal"])
@pytest.mark.parametrize("rows", ["sparse", "dense", "none"])
@pytest.mark.parametrize("seed", range(2))
def test_answers_with_all_rows_and_preconditioners_agree_with_the_textbook(
    seed, rows, preconditioner, monkeypatch
):
    """Rows are sparse, dense or absent, and faces are preconditioned by the model, by
    the diagonal or not at all.
    """
    qp, rng = random_qp(seed), np.random.default_rng(seed)
    n = qp.q.size
    W = rng.standard_normal((n, n))
    A = no_rows(n) if rows == "none" else rng.standard_normal((min(n, 3), n))
    inside = np.clip(rng.standard_normal(n), qp.lb, qp.ub)
    if rows == "sparse":
        monkeypatch.setattr(rows_module, "MAX_DENSE_ENTRIES", 0)
        A = csr_array(A)
    qp = replace(qp, P=W @ W.T / n + np.eye(n), A=A, b=A @ inside)
    solver = SMALBE(preconditioner=preconditioner)
    same_answers(qp, solver)


@pytest.mark.parametrize("seed", range(10))
def test_recovered_multipliers_fit_the_gradient_on_free_components(seed):
    """They minimise the residual there, also if the rows are dependent."""
    qp, options = random_qp(seed), SOLVERS["smalbe"]
    problem = prepared_problem(qp, 12)
    run = outer_loop(problem, qp, options)
    start = run.first(0 * qp.q, np.zeros(len(problem.rows.C)), M=1.0, rho=1e4)
    at = run.solve(1e-8, start)
    x, a, z_box, Px = run.solver.point(at.nu, at.mu, at.rho, qp.lb, qp.ub)
    C, free = problem.rows.C, (at.nu > problem.bounds[0]) & (at.nu < problem.bounds[1])
    r = qp.P @ x + qp.q
    best = np.linalg.lstsq(C.T[free], -r[free], rcond=None)[0]
    left, least = r + C.T @ a, r + C.T @ best

    assert x == pytest.approx(np.clip(problem.rows.x_tilde + at.nu, qp.lb, qp.ub))
    assert Px == pytest.approx(qp.P @ x, rel=1e-9, abs=1e-9)
    size = np.abs(r).max()
    assert left[free] == pytest.approx(least[free], abs=1e-9 * size)
    low, high = x <= qp.lb, x >= qp.ub
    expected = np.where(low, -np.maximum(left, 0), 0) - np.where(
        high, np.minimum(left, 0), 0
    )
    assert z_box == pytest.approx(expected, abs=1e-9 * size)


def test_the_stopping_test_is_that_of_the_other_solvers():
    """The points are near a solution or far from it, with multipliers of
    either sign.
    """
    for seed in range(20):
        rng = np.random.default_rng(seed)
        qp = random_qp(seed)
        solution = SOLVERS["smalbe"].prepare(qp, 1e-8)()
        if solution.status is not Status.SOLVED:
            continue
        for size in (0.0, 1e-9, 1e-6, 1e-3, 1.0, 1e3):
            point = disturbed(qp, solution, size, rng)
            G = np.ascontiguousarray(
                qp.A.toarray() if hasattr(qp.A, "toarray") else qp.A
            )
            for rows in (G, csr_array(G)):
                errors = compiled.relative_residuals(
                    qp, point, 1e-8, qp.P @ point.x, qp.P.diagonal(), rows
                )
                found = max(errors[:2])
                expected = relative_residual(qp, point, 1e-8)
                assert found == pytest.approx(expected, rel=1e-6, abs=1e-13), seed


def disturbed(qp, solution, size, rng):
    """Return a random point within the bounds, at a relative distance of about `size`
    from a solution.
    """

    def noise(v):
        return v + size * (1 + np.abs(v)) * rng.standard_normal(v.size)

    x = np.clip(noise(solution.x), qp.lb, qp.ub)
    y, z = noise(solution.y), noise(solution.z_box)
    z = np.where(np.isinf(qp.lb), np.maximum(z, 0), z)
    z = np.where(np.isinf(qp.ub), np.minimum(z, 0), z)
    return replace(solution, x=x, y=y, z_box=z)


@pytest.mark.parametrize("name", ["smalbe", "smalbe-permon"])
@pytest.mark.parametrize("stored", ["integers", "with gaps"])
def test_any_storage_of_vectors_is_accepted(name, stored):
    """The problem is to minimise Σ i xᵢ² + qᵀx over Σ xᵢ = 2, 0 ≤ x ≤ 5."""
    P, q, A = 2 * np.diag([1, 2, 3, 4]), np.array([-1, -2, 3, -4]), np.ones((1, 4), int)
    b, lb, ub = np.array([2]), np.zeros(4, int), np.full(4, 5)
    if stored == "with gaps":
        P = np.repeat(np.repeat(P, 2, 0), 2, 1)[::2, ::2].astype(float)
        q, lb, ub = (np.repeat(v, 2)[::2].astype(float) for v in (q, lb, ub))
    qp = QP(P=P, q=q, A=A, b=b, G=no_rows(4), h=np.zeros(0), lb=lb, ub=ub)

    s = SOLVERS[name].prepare(qp, 1e-8)()
    y = -4 / 7  # 2i xᵢ + qᵢ + y = 0 for i = 1, 2, 4: 3/2 − 7y/8 = 2
    assert s.y == pytest.approx(y, abs=1e-7)
    assert s.x == pytest.approx([(1 - y) / 2, (2 - y) / 4, 0, (4 - y) / 8], abs=1e-7)
