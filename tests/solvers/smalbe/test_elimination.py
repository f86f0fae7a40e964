"""Elimination of the free variables: the same solution from a smaller QP."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from mortarbench.harness import QP, Box, Discs, Status, no_rows
from mortarbench.harness.names import parse
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.elimination import eliminate_free
from mortarbench.solvers.smalbe.solver import SMALBE
from tests.support import ROOT

EXACT = SMALBE()
#: blocks of docs/own-bodies.md; supports prevent the upper one from sliding
BLOCKS = """
mesh = "blocks.msh"
length_unit = "mm"
contact = "nts"
steps = 1
friction = "coulomb"
mu = 0.3
bodies = [
    {{ name = "lower", E = {E}, nu = 0.3 }},
    {{ name = "upper", E = 210e9, nu = 0.3 }},
]
supports = [
    {{ boundary = "base", fix = ["x", "y", "z"] }},
    {{ boundary = "foot", fix = ["x", "y"] }},
]
loads = [{{ boundary = "top", traction = [0, 0, -1e6] }}]
contacts = [{{ slave = "foot", master = "table" }}]
"""


@pytest.fixture
def dual():
    """Draw F positive definite, with the first half of the variables free and r
    equality rows, of which `apart` have no entries in free variables.
    """

    def draw(seed, n=24, r=3, apart=0):
        rng = np.random.default_rng(seed)
        W = rng.standard_normal((n, n))
        G, x = rng.standard_normal((r, n)), rng.random(n)
        G[:apart, : n // 2] = 0
        return QP(
            P=W @ W.T / n + 0.1 * np.eye(n), q=rng.standard_normal(n),
            A=G, b=G @ x, G=no_rows(n), h=np.zeros(0),
            lb=np.where(np.arange(n) < n // 2, -np.inf, 0.0), ub=np.full(n, np.inf),
        )  # fmt: skip

    return draw


@pytest.mark.parametrize("seed", [271828, 314159])
@pytest.mark.parametrize(("r", "apart"), [(0, 0), (3, 0), (3, 1), (3, 3)])
def test_recovery_yields_a_kkt_point(dual, seed, r, apart):
    qp = dual(seed, r=r, apart=apart)
    small = eliminate_free(qp)
    solution = small.recover(EXACT.prepare(small.qp, 1e-11)())

    assert small.qp.sizes["variables"] == 12
    assert small.qp.sizes["equalities"] == apart
    assert solution.status is Status.SOLVED
    assert kkt_residuals(qp, solution).worst <= 1e-9


def test_upper_bounds_are_those_of_the_remaining_variables(dual):
    qp = dual(271828)
    tight = replace(
        qp, ub=np.where(np.isinf(qp.lb), np.inf, 0.1 + 0.01 * np.arange(24))
    )
    small = eliminate_free(tight)
    solution = small.recover(EXACT.prepare(small.qp, 1e-11)())

    assert (small.qp.ub == tight.ub[12:]).all()
    assert (solution.z_box > 0).any()
    assert kkt_residuals(tight, solution).worst <= 1e-9


def test_more_rows_than_free_variables_leave_rows(dual):
    """14 rows determine the 12 free variables; two combinations of the rows remain."""
    qp = dual(271828, r=14)
    small = eliminate_free(qp)
    solution = small.recover(EXACT.prepare(small.qp, 1e-11)())

    assert small.qp.sizes["equalities"] == 2
    assert kkt_residuals(qp, solution).worst <= 1e-9


def test_the_reduced_matrix_is_the_hessian_along_optimal_free_variables(dual):
    """½vᵀP̂v + q̂ᵀv differs by a constant from the minimum of the cost over x_E."""
    qp = dual(271828)
    small = eliminate_free(qp)
    rng = np.random.default_rng(161803)
    gaps = []
    for _ in range(3):
        v = rng.random(12)
        K = np.block(
            [[qp.P[:12, :12], qp.A[:, :12].T], [qp.A[:, :12], np.zeros((3, 3))]]
        )
        rhs = np.append(-qp.q[:12] - qp.P[:12, 12:] @ v, qp.b - qp.A[:, 12:] @ v)
        x = np.append(np.linalg.solve(K, rhs)[:12], v)
        gaps.append(qp.objective(x) - small.qp.objective(v))
    dense = small.qp.P @ np.eye(12)

    assert gaps == pytest.approx([gaps[0]] * 3)
    assert dense == pytest.approx(dense.T)


def test_the_order_of_the_variables_does_not_matter(dual):
    """Free variables are consecutive, so that P can be a view, or scattered."""
    qp = dual(314159, apart=1)
    order = np.random.default_rng(577215).permutation(24)
    mixed = replace(
        qp, P=qp.P[np.ix_(order, order)], q=qp.q[order], A=qp.A[:, order],
        lb=qp.lb[order],
    )  # fmt: skip
    one, other = eliminate_free(qp).qp, eliminate_free(mixed).qp
    bounded = order[order >= 12] - 12

    assert other.P == pytest.approx(one.P[np.ix_(bounded, bounded)])
    assert other.q == pytest.approx(one.q[bounded])


@pytest.mark.parametrize("why", ["no free", "all free", "singular", "rows", "operator"])
def test_variables_that_cannot_be_eliminated_remain(dual, why):
    qp = dual(271828)
    inf = np.full(24, np.inf)
    changed = {
        "no free": dict(lb=np.zeros(24)),
        "all free": dict(lb=-inf),
        "singular": dict(P=np.diag(np.r_[np.zeros(12), np.ones(12)])),
        "rows": dict(A=np.ones((2, 24)), b=np.array([1.0, 2.0])),
        "operator": dict(P=type("Operator", (), {"shape": (24, 24)})()),
    }

    assert eliminate_free(replace(qp, **changed[why])) is None


def test_elimination_does_not_change_the_solution(dual):
    qp = dual(314159, apart=1)
    plain, small = EXACT.prepare(qp, 1e-10)(), eliminate_free(qp)
    recovered = small.recover(EXACT.prepare(small.qp, 1e-10)())

    assert recovered.x == pytest.approx(plain.x, abs=1e-7)
    assert recovered.y == pytest.approx(plain.y, abs=1e-6)
    assert recovered.z_box == pytest.approx(plain.z_box, abs=1e-7)


def test_factorised_columns_and_the_check_count_as_products(dual):
    qp = with_discs(dual(271828))
    c = EXACT.prepare(qp, 1e-6)().counts
    inner = EXACT.prepare(eliminate_free(qp).qp, 1e-6)().counts

    assert c["factorised_columns"] == 12
    assert c["P_products"] == inner["P_products"] + 12 + 1


def test_rows_nearly_independent_of_free_variables_are_not_eliminated(dual):
    qp = dual(271828)
    A = qp.A.copy()
    A[0, :12] *= 1e-5

    assert eliminate_free(replace(qp, A=A)) is None


def with_discs(qp):
    """Replace the bounds of the last eight variables by four discs."""
    lb = np.where(np.arange(24) < 16, qp.lb, -np.inf)
    discs = Discs(np.arange(16, 24).reshape(4, 2), [0.1, 0.2, 0.0, 30.0])
    return replace(qp, sets=(Box(lb, qp.ub), discs))


@pytest.mark.parametrize("apart", [0, 1])
def test_variables_of_discs_are_not_eliminated(dual, apart):
    qp = with_discs(dual(271828, apart=apart))
    small = eliminate_free(qp)
    solution = small.recover(EXACT.prepare(small.qp, 1e-11)())

    assert small.qp.sets[1].index.tolist() == [[4, 5], [6, 7], [8, 9], [10, 11]]
    assert kkt_residuals(qp, solution).worst <= 1e-9


@pytest.mark.parametrize("ratio", [1.0, 1e2, 1e4])
def test_friction_along_supports_takes_few_products_for_any_stiffness(tmp_path, ratio):
    """Supports along the contact make tangential rows nearly linearly dependent on the
    rows of supports. In variables that include the support forces, the number of
    products grows in proportion to the ratio of the moduli: 200 270 for 1e4.
    """
    shutil.copy(ROOT / "tests" / "data" / "blocks.msh", tmp_path)
    path = tmp_path / "blocks.toml"
    path.write_text(BLOCKS.format(E=210e9 * ratio))
    case = parse(f"bodies:{path}/dual", PROBLEMS)
    s = SMALBE().prepare(case.build(reference_solution).qp, 1e-8)()

    assert s.status is Status.SOLVED
    assert s.counts["P_products"] - s.counts["factorised_columns"] < 600


@pytest.mark.parametrize("count", [60, pytest.param(400, marks=pytest.mark.slow)])
def test_discs_that_depend_exactly_on_free_variables_are_solved(count):
    """P = WWᵀ with W_I = T W_E: the Schur complement consists of rounding errors, along
    which large discs permit large motions.
    """
    for seed in range(count):  # seed 44 needs Newton steps without a CG step
        rng = np.random.default_rng(seed)
        k, e = 2 * int(rng.integers(1, 4)), int(rng.integers(1, 7))
        W = rng.standard_normal((e, e))
        W = np.vstack([W, rng.standard_normal((k, e)) @ W])
        P = W @ W.T
        qp = QP(
            P=(P + P.T) / 2, q=-P @ rng.standard_normal(e + k),
            A=np.zeros((0, e + k)), b=np.zeros(0), G=no_rows(e + k), h=np.zeros(0),
            sets=(Box.unbounded(e + k), Discs(
                np.arange(e, e + k).reshape(-1, 2), rng.choice([1.0, 1e8], size=k // 2)
            )),
        )  # fmt: skip
        s = SMALBE().prepare(qp, 1e-8)()

        assert s.status is Status.SOLVED, seed
        assert kkt_residuals(qp, s).worst <= 5e-8, seed
