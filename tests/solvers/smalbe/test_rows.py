"""Equality rows with a sparse Cholesky factor: rows, preconditioners and answers equal
those of dense rows.
"""

from functools import partial

import numpy as np
import pytest
from scipy.sparse import csr_array, random_array

from mortarbench.harness import QP, Status, no_rows
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.solvers.smalbe import rows as module
from mortarbench.solvers.smalbe.compiled import Rows
from mortarbench.solvers.smalbe.driver import outer_loop
from mortarbench.solvers.smalbe.projected import (
    by_lanczos,
    projected_problem,
    unchanged,
)
from mortarbench.solvers.smalbe.rows import (
    DenseRows,
    SparseRows,
    equality_rows,
    orthonormal_rows,
    sparse_rows,
)
from mortarbench.solvers.smalbe.solver import SMALBE

SEED = 20210805


@pytest.fixture
def G():
    """Return nine rows of very different norms with forty unknowns."""
    rng = np.random.default_rng(SEED)
    entries = random_array((9, 40), density=0.2, rng=rng, data_sampler=rng.normal)
    return csr_array(np.logspace(-3, 3, 9)[:, None] * entries.tocsr())


@pytest.fixture
def e(G):
    return G @ np.linspace(-1, 2, G.shape[1])


ALL, THIRD = np.ones(40, dtype=bool), np.arange(40) % 3 == 0


@pytest.fixture(params=["held", "all", "all, refactorised"])
def pair(G, e, request, monkeypatch):
    """Return the rows in sparse and in dense form.

    The set of components that may be fixed determines how faces are factorised.
    """
    if "refactorised" in request.param:
        monkeypatch.setattr(module, "MAX_BORDER", 0)
    bounded = THIRD if request.param == "held" else ALL
    return sparse_rows(G, e, bounded), orthonormal_rows(G, e)


@pytest.fixture
def face():
    """Return a face with every third component fixed."""
    return ~THIRD


def columns(apply, n):
    return np.column_stack([apply(v) for v in np.eye(n)])


def test_the_rows_are_orthonormal_and_span_the_original_rows(pair):
    sparse, dense = pair
    C = columns(lambda v: sparse.C @ v, 40)

    assert C @ C.T == pytest.approx(np.eye(9), abs=1e-12)
    assert columns(sparse.project, 40) == pytest.approx(
        columns(dense.project, 40), abs=1e-12
    )
    assert columns(lambda a: sparse.C.T @ a, 9) == pytest.approx(C.T, abs=1e-14)
    assert sparse.x_tilde == pytest.approx(dense.x_tilde, rel=1e-9, abs=1e-10)


def test_multipliers_belong_to_the_original_rows(pair, G):
    a = np.arange(1.0, 10.0)

    for rows in pair:
        assert G.T @ rows.multipliers(a) == pytest.approx(rows.C.T @ a, abs=1e-10)


def test_the_least_squares_multipliers_on_a_face(pair, face):
    r = np.linspace(-2, 1, 40)
    sparse, dense = ((r + rows.C.T @ rows.fitted(face, r))[face] for rows in pair)

    assert sparse == pytest.approx(dense, abs=1e-8)


@pytest.mark.parametrize("rho", [0.5, 3.0, 1e4])
def test_a_model_of_the_penalty_is_the_same_preconditioner(
    G, e, face, rho, monkeypatch
):
    """For P = I, whose model has no Ritz vectors, results with a factor, with an array
    and by hand agree.
    """
    qp = QP(
        P=np.eye(40), q=np.ones(40), A=G, b=e, G=no_rows(40), h=np.zeros(0),
        lb=np.where(face, -np.inf, -0.5), ub=np.full(40, np.inf),
    )  # fmt: skip
    found = []
    for most in (0, 10_000):
        monkeypatch.setattr(module, "MAX_DENSE_ENTRIES", most)
        problem = projected_problem(qp, partial(by_lanczos, steps=3))
        solver = outer_loop(problem, qp, SMALBE()).solver
        found.append(columns(lambda v, s=solver: s.precondition(face, v, rho), 40))
    sparse, dense = found
    C = orthonormal_rows(G, e).C
    B = np.eye(40) + max(rho - 1, 0) * C.T @ C
    inverse = np.zeros((40, 40))
    inverse[np.ix_(face, face)] = np.linalg.inv(B[np.ix_(face, face)])

    assert dense == pytest.approx(sparse, abs=1e-9)
    assert sparse[np.ix_(face, face)] == pytest.approx(
        inverse[np.ix_(face, face)], abs=1e-9
    )
    if rho > 1:  # otherwise, nothing is preconditioned
        assert sparse == pytest.approx(inverse, abs=1e-9)


def test_dependent_rows_are_treated_as_dense(G, e, monkeypatch):
    monkeypatch.setattr(module, "MAX_DENSE_ENTRIES", 0)
    twice = csr_array(np.vstack([G.toarray(), G.toarray()[3:4]]))

    assert isinstance(equality_rows(G, e, ALL), SparseRows)
    rows = equality_rows(twice, np.append(e, e[3]), ALL)
    assert isinstance(rows, DenseRows)
    assert len(rows.C) == 9


def test_an_independent_subset_replaces_too_many_dependent_rows(G, e, monkeypatch):
    monkeypatch.setattr(module, "MAX_DENSE_ENTRIES", 0)
    monkeypatch.setattr(module, "too_large", lambda n, copies: "too large")
    dependent = np.vstack(
        [G.toarray(), G.toarray()[1] - 2 * G.toarray()[3], np.zeros(40)]
    )
    right = np.append(e, [e[1] - 2 * e[3], 0.0])
    rows = equality_rows(csr_array(dependent), right, ALL)

    assert isinstance(rows, SparseRows)
    assert len(rows.C) == 9
    assert rows.consistent
    assert dependent @ rows.x_tilde == pytest.approx(right, rel=1e-12, abs=1e-12)
    a = np.random.default_rng(SEED).normal(size=9)
    assert dependent.T @ rows.multipliers(a) == pytest.approx(rows.C.T @ a, abs=1e-12)
    right[9] += 1
    assert not equality_rows(csr_array(dependent), right, ALL).consistent


def test_a_qp_with_dependent_sparse_rows_is_solved(G, e, monkeypatch):
    """The solver uses independent rows; residuals are those of the original rows."""
    dependent = csr_array(np.vstack([G.toarray(), 2 * G.toarray()[3:4]]))
    qp = QP(
        P=np.eye(40), q=np.ones(40), A=dependent, b=np.append(e, 2 * e[3]),
        G=no_rows(40), h=np.zeros(0), lb=np.where(THIRD, -0.5, -np.inf),
        ub=np.full(40, np.inf),
    )  # fmt: skip
    dense = SMALBE().prepare(qp, 1e-8)()
    monkeypatch.setattr(module, "MAX_DENSE_ENTRIES", 0)
    monkeypatch.setattr(module, "too_large", lambda n, copies: "too large")
    sparse = SMALBE().prepare(qp, 1e-8)()

    assert sparse.status is dense.status
    assert kkt_residuals(qp, sparse).worst <= 1e-7
    assert sparse.x == pytest.approx(dense.x, abs=1e-6 * np.abs(dense.x).max())


@pytest.mark.parametrize("border", [True, False], ids=["border", "whole"])
@pytest.mark.parametrize("shift", [1e-6, 1e-10, 1e-14])
def test_a_motion_of_fixed_components_only_leaves_a_factor(monkeypatch, border, shift):
    """On the free components, the rows consist of integers and one row is the sum of
    two others.

    This row differs from the sum only in fixed components. A right-hand side G_F v has
    a solution for any shift.
    """
    if not border:
        monkeypatch.setattr(module, "MAX_BORDER", 0)
    rng = np.random.default_rng(7)
    free = rng.integers(-3, 4, size=(12, 40)).astype(float)
    free[11] = free[0] + free[5]
    held = np.zeros((12, 4))
    held[11] = 1e-5 * np.arange(1, 5)
    held[0, 0] = held[5, 1] = 7.0
    dense = np.hstack([held, free])
    bounded = np.arange(44) < 4
    rows = sparse_rows(csr_array(dense), dense @ np.ones(44), bounded)
    assert rows is not None
    on_face = np.arange(44) >= 4
    unit = dense / np.linalg.norm(dense, axis=1)[:, None]
    t = unit[:, on_face] @ rng.normal(size=40)
    if border:
        active = (~on_face[rows.bounded]).astype(float)
        y = rows.factor.shifted_without(shift, rows.of_bounded, active)(t)
    else:
        y = rows.factorised(on_face, shift)(t)
    G_F = unit[:, on_face]
    missed = G_F @ (G_F.T @ y) + shift * (unit @ (unit.T @ y)) - t
    assert np.abs(missed).max() <= 1e-6 * np.abs(t).max()


@pytest.mark.parametrize("preconditioner", ["model", "sparse", "none", "diagonal"])
def test_the_same_steps_lead_to_the_same_point(G, e, monkeypatch, preconditioner):
    rng = np.random.default_rng(SEED)
    W = rng.normal(size=(40, 40))
    qp = QP(
        P=W @ W.T + np.eye(40), q=rng.normal(size=40), A=G, b=e, G=no_rows(40),
        h=np.zeros(0), lb=np.linspace(-1, 2, 40) - 0.3, ub=np.full(40, np.inf),
    )  # fmt: skip
    solver = SMALBE(preconditioner=preconditioner, lanczos_steps=1)
    dense = solver.prepare(qp, 1e-8)()
    monkeypatch.setattr(module, "MAX_DENSE_ENTRIES", 0)
    sparse = solver.prepare(qp, 1e-8)()

    assert dense.status is sparse.status is Status.SOLVED
    assert kkt_residuals(qp, sparse).worst <= 1e-7
    assert sparse.x == pytest.approx(dense.x, abs=1e-6)


def test_a_right_hand_side_of_rounding_size_counts_as_zero(G):
    """A right-hand side of 1e-18 is a rounding error and does not set a scale for
    residuals.
    """
    e = 1e-18 * (-1.0) ** np.arange(9)
    size, nu = np.linalg.norm(G.toarray()), np.full(40, 1e-9)
    nu[0] = 1e3

    for rows in (sparse_rows(G, e, ALL), orthonormal_rows(G, e)):
        inside = rows.project(nu) + 1e-9 * nu
        assert np.linalg.norm(G @ inside) < size
        assert Rows(rows).met(inside, 1e-8, 0.0)
        assert not Rows(rows).met(nu, 1e-8, 0.0)


def test_rows_of_an_earlier_problem_are_those_of_an_equal_matrix():
    dense = np.eye(2, 3)
    sparse = csr_array(dense)
    for one, other in ((dense, sparse), (sparse, dense)):
        assert unchanged(one, one)
        assert unchanged(one, one.copy())
        for different in (2 * one, np.eye(2, 4), csr_array(np.eye(2, 4)), other):
            assert not unchanged(one, different)
