"""MPRGP with incomplete factors of the free submatrix of a sparse P."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array, diags_array, kron

import mortarbench as mb
from mortarbench.harness import QP, Status, no_rows
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.common.stopping import relative_residual
from mortarbench.solvers.smalbe.compiled import IncompleteFactor, sparsity
from mortarbench.solvers.smalbe.preconditioner import has_sparse_factor
from tests.support.incomplete_cholesky import (
    incomplete_cholesky,
    incomplete_inverse,
)
from tests.support.sparse_qps import laplacian, qp_with_minimum, sparse_matrix

FACTORS = replace(SOLVERS["smalbe"], preconditioner="incomplete")
KEEP = 0.99  #: share of dropped entries that is added to the diagonal


def factor(P, keep=True):
    return IncompleteFactor(csr_array(P), 1.0, keep)


def boxed(P, q, lb, ub):
    n = q.size
    return QP(
        P=P, q=q, A=no_rows(n), b=np.zeros(0), G=no_rows(n), h=np.zeros(0), lb=lb, ub=ub
    )


def primal(name):
    return mb.build(f"{name}/primal").qp


def half_string(n):
    """Return the QP of a string over an obstacle that ends in the middle of
    the string.
    """
    qp = primal(f"string/n={n}")
    lb = qp.lb.copy()
    lb[n // 2 :] = -np.inf
    return boxed(qp.P, qp.q, lb, qp.ub)


def grid(n):
    T = diags_array(
        [-np.ones(n - 1), 2 * np.ones(n), -np.ones(n - 1)], offsets=[-1, 0, 1]
    )
    one = diags_array(np.ones(n))
    return csr_array(kron(T, one) + kron(one, T))


# --- the factor ---------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 7, 300, 1000])
def test_on_a_tridiagonal_matrix_the_factor_is_the_one_of_cholesky(n):
    rng = np.random.default_rng(n)
    off = rng.standard_normal(n - 1)
    around = np.abs(np.r_[off, 0]) + np.abs(np.r_[0, off])
    P = csr_array(diags_array([off, around + 0.1, off], offsets=[-1, 0, 1]))
    F = factor(P)
    for share in (1.0, 0.8, 0.2, 0.0):
        free = rng.random(n) <= share
        v = np.where(free, rng.standard_normal(n), 0)
        x = np.zeros(n)
        x[free] = np.linalg.solve(P.toarray()[np.ix_(free, free)], v[free])

        assert F.solve(free, v) == pytest.approx(x, rel=1e-9, abs=1e-9)
    assert F.keep == KEEP
    assert F.shift == 0


@pytest.mark.parametrize("kind", ["five-point", "nine-point", "line", "graph", "wide"])
@pytest.mark.parametrize("seed", range(2))
def test_the_factor_agrees_with_one_in_numpy(seed, kind):
    """Factors by diagonals and by columns, from one end or from both, agree on every
    face with a factor that is computed entry by entry.
    """
    rng = np.random.default_rng([7, seed])
    side = int(rng.integers(9, 16))
    P = grid(side)
    if kind == "nine-point":
        T = diags_array([np.ones(side - 1)] * 2, offsets=[-1, 1])
        P = csr_array(P - 0.3 * kron(T, T))
    elif kind == "line":
        P = laplacian("line", side**2, rng)
    elif kind == "graph":
        P = sparse_matrix(int(rng.integers(2, 80)), rng)
    elif kind == "wide":
        P = csr_array(
            P + diags_array([np.ones(3)] * 2, offsets=[-(side**2) + 3, side**2 - 3])
        )
    n = P.shape[0]
    jitter = 10 ** rng.uniform(-0.3, 0.3, n)
    P = csr_array(diags_array(jitter) @ P @ diags_array(jitter))
    P = csr_array(P + diags_array(np.asarray(abs(P).sum(axis=0)).ravel()))  # dominant
    scale, keep = float(rng.random()) + 0.1, bool(seed % 2)
    F = IncompleteFactor(P, scale, keep)
    for share in (1.0, 0.9, 0.5, 0.05, 0.95):
        free = rng.random(n) <= share
        v = np.where(free, rng.standard_normal(n), 0)
        x = scale * (incomplete_inverse(P.toarray(), free, KEEP if keep else 0.0) @ v)

        assert F.solve(free, v) == pytest.approx(x, abs=1e-12 * abs(x).max(initial=1))
    assert F.keep == (KEEP if keep else 0)
    assert F.shift == 0


def test_on_a_five_point_grid_most_of_the_dropped_entries_are_compensated():
    """The row sums of M differ from those of P by the uncompensated share of the
    dropped entries.
    """
    P = grid(15)
    M = np.linalg.inv(
        np.column_stack([factor(P).solve(np.ones(225, bool), e) for e in np.eye(225)])
    )
    plain = np.linalg.inv(
        np.column_stack(
            [factor(P, False).solve(np.ones(225, bool), e) for e in np.eye(225)]
        )
    )
    lost, lost_by_plain = (np.abs((A - P).sum(axis=1)).max() for A in (M, plain))

    assert lost <= 0.1 * lost_by_plain


def test_the_diagonal_is_shifted_if_pivots_fail():
    """The incomplete factorisation of Kershaw's matrix (J. Comput. Phys. 26, 1978) has
    a negative pivot.
    """
    P = np.array([[3.0, -2, 0, 2], [-2, 3, -2, 0], [0, -2, 3, -2], [2, 0, -2, 3]])
    F = factor(P, keep=False)
    M = np.column_stack([F.solve(np.ones(4, bool), e) for e in np.eye(4)])

    assert np.linalg.eigvalsh(P).min() > 0
    assert incomplete_cholesky(P, 0.0)[1].min() < 0
    assert F.keep == 0
    assert F.shift > 0
    assert np.linalg.eigvalsh(M).min() > 0


@pytest.mark.parametrize("seed", range(4))
def test_the_inverse_is_positive_definite_on_every_face(seed):
    """This also holds for an indefinite matrix with a positive diagonal."""
    rng = np.random.default_rng([8, seed])
    P = sparse_matrix(60, rng)
    if seed % 3 == 0:
        P = csr_array(P - 0.7 * diags_array(P.diagonal()))
    n, F = P.shape[0], IncompleteFactor(P)
    for share in (1.0, 0.6, 0.1, 0.0):
        free = rng.random(n) <= share
        M = np.column_stack([F.solve(free, e) for e in np.eye(n)])

        assert np.isfinite(M).all()
        assert pytest.approx(M.T, abs=1e-9 * abs(M).max()) == M
        assert (M[~free] == 0).all()
        if free.any():
            assert np.linalg.eigvalsh(M[np.ix_(free, free)]).min() > 0


# --- use of the factor ---------------------------------------------------------------


def test_a_sparse_p_with_bounds_has_an_incomplete_factor():
    assert has_sparse_factor(primal("journal-bearing/n=5"))
    assert has_sparse_factor(
        boxed(csr_array([[2.0]]), np.ones(1), np.zeros(1), np.ones(1))
    )


@pytest.mark.parametrize(
    "reason", ["dense", "operator", "rows", "diagonal", "full", "nothing"]
)
def test_unsuitable_matrices_have_no_incomplete_factor(reason):
    qp = primal("journal-bearing/n=9")
    n, one = 81, np.ones((1, 81))
    if reason == "dense":
        qp = replace(qp, P=qp.P.toarray())
    elif reason == "operator":

        class Operator:
            shape = (n, n)

            def __matmul__(self, v):
                return qp.P @ v

        qp = replace(qp, P=Operator())
    elif reason == "rows":
        qp = replace(qp, A=one, b=np.ones(1))
    elif reason == "diagonal":
        qp = replace(qp, P=csr_array(qp.P - diags_array(np.eye(n)[0] * qp.P[0, 0])))
    elif reason == "full":
        qp = replace(qp, P=csr_array(np.eye(n) + one.T @ one))
    else:
        qp = boxed(csr_array((0, 0)), np.zeros(0), np.zeros(0), np.zeros(0))

    assert not has_sparse_factor(qp)


def test_requesting_an_unavailable_factor_is_refused_with_the_reason():
    solver = replace(SOLVERS["smalbe"], preconditioner="incomplete")
    qp = primal("journal-bearing/n=5")

    assert solver.declines(qp) is None
    assert "needs a sparse P" in solver.declines(replace(qp, P=qp.P.toarray()))


def test_sparsity_by_hand():
    """The matrices are those of a grid in its natural order, of this grid with one
    diagonal entry scaled by 1/100, and of a string, and two diagonal matrices.
    """
    unit = diags_array(np.r_[np.full(35, 10.0), 1.0])
    scaled = csr_array(unit @ grid(6) @ unit)

    assert sparsity(grid(6))[:3] == (25.0, 36 / (2 * 3.5), 1.0)
    assert sparsity(scaled)[:3] == (25.0, 36 / (2 * 3.5), 100.0)
    assert sparsity(laplacian("line", 9, np.random.default_rng(1)))[:2] == (0.0, 4.5)
    assert sparsity(grid(6))[3:] == (8.0, 0.0)
    assert sparsity(csr_array(np.eye(3))) == (0.0, 0.0, 1.0, 1.0, 1.0)
    assert sparsity(csr_array(np.diag([1.0, 0.0])))[0] == np.inf


@pytest.mark.parametrize(
    ("case", "pays"),
    [
        ("journal-bearing/n=20/eccentricity=0.9", True),
        ("journal-bearing/n=60", True),
        ("torsion/n=70", True),
        ("string/n=300", True),
        ("obstacle/dim=2/n=40/shape=flat", False),
        ("torsion/n=30", False),
        ("string/n=50", False),
    ],
)
def test_a_factor_is_used_if_it_saves_time(case, pays):
    qp = primal(case)
    s = SOLVERS["smalbe"].prepare(qp, 1e-6)()

    assert ("factorisations" in s.counts) is pays
    assert relative_residual(qp, s, 1e-6) <= 1e-6


def test_in_a_random_order_no_factor_is_used():
    """In random order, the factor is three times less accurate and costs
    twice as much.
    """
    qp = primal("torsion/n=70")
    order = np.random.default_rng(3).permutation(qp.q.size)
    P = csr_array(qp.P)[order][:, order]
    qp = boxed(P, qp.q[order], qp.lb[order], qp.ub[order])
    s = SOLVERS["smalbe"].prepare(qp, 1e-6)()

    assert "factorisations" not in s.counts
    assert relative_residual(qp, s, 1e-6) <= 1e-6


# --- the method ---------------------------------------------------------------------


@pytest.mark.parametrize(
    "seeds", [range(10), pytest.param(range(10, 1000), marks=pytest.mark.slow)], ids=str
)
@pytest.mark.parametrize("tol", [1e-6, 1e-10])
@pytest.mark.parametrize("solver", [SOLVERS["smalbe"], FACTORS], ids=["auto", "factor"])
def test_a_search_finds_no_sparse_qp_that_it_does_not_solve(seeds, tol, solver):
    for seed in seeds:
        qp, x = qp_with_minimum(seed)
        s = solver.prepare(qp, tol)()

        assert s.status is Status.SOLVED, seed
        assert kkt_residuals(qp, s).worst <= 5 * tol, seed
        assert (qp.lb <= s.x).all(), seed
        assert (s.x <= qp.ub).all(), seed
        low = qp.objective(x)
        assert qp.objective(s.x) <= low + 1e-3 * (abs(low) + x @ (qp.P @ x)), seed


@pytest.mark.parametrize("seed", range(5))
def test_no_step_increases_the_cost(seed):
    qp, _ = qp_with_minimum(seed)
    solver = replace(SOLVERS["smalbe"], preconditioner="incomplete", history=True)
    s = solver.prepare(qp, 1e-8)()
    cost = s.history["cost"] if s.history else np.zeros(0)
    size = np.abs(cost).max(initial=0)

    assert s.status is Status.SOLVED
    assert (np.diff(np.r_[0 * size, cost]) <= 1e-9 * size)[1:].all()


@pytest.mark.parametrize("seed", range(4))
def test_the_unit_of_a_variable_changes_nothing(seed):
    """If bounds, cost and matrix are expressed in other units, the steps are the same
    up to rounding.
    """
    rng = np.random.default_rng([9, seed])
    qp, _ = qp_with_minimum(seed, 100)
    unit = 2.0 ** rng.integers(-9, 9)
    other = boxed(csr_array(qp.P) * unit**2, qp.q * unit, qp.lb / unit, qp.ub / unit)
    s, t = (FACTORS.prepare(p, 1e-8)() for p in (qp, other))

    assert s.counts == t.counts
    assert t.x * unit == pytest.approx(s.x, rel=1e-12)


@pytest.mark.parametrize(
    ("case", "most"),
    [
        ("journal-bearing/n=50/eccentricity=0.9", 20),
        ("journal-bearing/n=100/eccentricity=0.9", 30),
        ("journal-bearing/n=100/eccentricity=0.5", 45),
        ("journal-bearing/n=100/eccentricity=0.99", 40),
        ("journal-bearing/n=50", 45),
        ("string/n=1000", 60),
        ("torsion/n=50", 45),
        ("obstacle/dim=2/n=64/shape=hemisphere", 40),
        ("obstacle/dim=1/n=64", 20),
    ],
)
def test_on_the_named_families_few_products_are_needed(case, most):
    """PERMON's unmerged branch takes 74 and 105 products on the first two cases."""
    qp = primal(case)
    s = FACTORS.prepare(qp, 1e-6)()

    assert s.status is Status.SOLVED
    assert relative_residual(qp, s, 1e-6) <= 1e-6
    assert s.counts["P_products"] <= most


def test_half_a_string_takes_about_a_fifth_of_the_products_of_permon():
    """PERMON's unmerged branch takes 224 products, about one for each
    intermediate face.
    """
    qp = half_string(1000)
    s = FACTORS.prepare(qp, 1e-6)()

    assert relative_residual(qp, s, 1e-6) <= 1e-6
    assert s.counts["P_products"] <= 45


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "most"),
    [("journal-bearing/n=200/eccentricity=0.9", 50), ("string/n=10000", 120),
     ("journal-bearing/n=300", 160), ("obstacle/dim=2/n=257/shape=hemisphere", 100)],
)  # fmt: skip
def test_on_large_families_few_products_are_needed(case, most):
    qp = primal(case)
    s = SOLVERS["smalbe"].prepare(qp, 1e-6)()

    assert relative_residual(qp, s, 1e-6) <= 1e-6
    assert s.counts["P_products"] <= most


def test_the_solver_stops_at_the_requested_residual():
    """Since steps are cheap, the final residual is not far below the tolerance:
    it is at least one twentieth of the tolerance.
    """
    for case in ("journal-bearing/n=50/eccentricity=0.9", "torsion/n=50",
                 "journal-bearing/n=50"):  # fmt: skip
        for tol in (1e-4, 1e-6, 1e-8):
            qp = primal(case)
            residual = relative_residual(qp, FACTORS.prepare(qp, tol)(), tol)

            assert 0.05 * tol <= residual <= tol


def test_all_variables_start_at_their_bounds():
    """No component is free, so the first face is empty."""
    qp = boxed(grid(6), np.ones(36), np.zeros(36), np.ones(36))
    s = FACTORS.prepare(qp, 1e-8)()

    assert s.status is Status.SOLVED
    assert not s.x.any()


def test_a_cost_without_a_bound_below_is_not_solved():
    """The problem is a floating membrane that is pulled to one side."""
    P = grid(5)
    P = csr_array(P - diags_array(np.asarray(P.sum(axis=0)).ravel()))
    inf = np.full(25, np.inf)
    s = FACTORS.prepare(boxed(P, np.ones(25), -inf, inf), 1e-6)()

    assert s.status is not Status.SOLVED


def test_a_floating_membrane_on_an_obstacle():
    """P is singular, so the last pivot of its factor consists of rounding errors."""
    P = grid(8)
    P = csr_array(P - diags_array(np.asarray(P.sum(axis=0)).ravel()))
    qp = boxed(P, np.ones(64), np.linspace(0, 1, 64), np.full(64, np.inf))
    s = FACTORS.prepare(qp, 1e-8)()

    assert s.status is Status.SOLVED
    assert kkt_residuals(qp, s).worst <= 1e-8


@pytest.mark.parametrize("spread", [10, 1e3, 1e6])
def test_a_varying_diagonal_of_trilinear_elements_preconditions_cg(spread):
    """With units of variables that differ by three orders of magnitude, CG without the
    diagonal takes more than 40 000 products.
    """
    n, rng = 30, np.random.default_rng(1)
    T = diags_array(
        [-np.ones(n - 1), 2 * np.ones(n), -np.ones(n - 1)], offsets=[-1, 0, 1]
    )
    M = diags_array(
        [np.ones(n - 1), 4 * np.ones(n), np.ones(n - 1)], offsets=[-1, 0, 1]
    )
    P = kron(kron(T, M), M) + kron(kron(M, T), M) + kron(kron(M, M), T)
    unit = diags_array(spread ** rng.uniform(-0.25, 0.25, n**3))
    P = csr_array(unit @ P @ unit)
    q = -np.sin(np.linspace(0, 9, n**3)) * unit.diagonal()
    qp = boxed(P, q, np.zeros(n**3), np.full(n**3, np.inf))
    s = SOLVERS["smalbe"].prepare(qp, 1e-8)()

    assert not has_sparse_factor(qp)
    assert s.status is Status.SOLVED
    assert kkt_residuals(qp, s).worst <= 1e-8
    assert s.counts["P_products"] <= 200


def test_a_sequence_starts_from_the_previous_solution():
    qp = primal("journal-bearing/n=40/eccentricity=0.9")
    prepare = FACTORS.chain(1e-8)
    first = prepare(qp)()
    near = replace(qp, P=csr_array(qp.P) * 3.0, q=qp.q * 3.01)
    second = prepare(near)()

    assert second.status is Status.SOLVED
    assert kkt_residuals(near, second).worst <= 1e-8
    assert second.counts["P_products"] <= first.counts["P_products"]
