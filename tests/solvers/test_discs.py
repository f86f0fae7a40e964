"""In-house solvers on discs and cones: planted solutions, extreme radii, products."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csc_array
from scipy.sparse.linalg import aslinearoperator

import mortarbench as mb
from mortarbench.harness import QP, Box, Discs, Status
from mortarbench.solvers import SOLVERS
from tests.support.discs import mindlin, natural_map, qp_on_cones, qp_on_discs

SMALBES = ["smalbe", "smalbe-paper", "smalbe-espreso"]
ON_CONES = ["projected-gradient", "nsgs"]
ON_DISCS = [*ON_CONES, *SMALBES]
TOL = 1e-9


def solve(name, qp, tol=TOL, **options):
    return replace(SOLVERS[name], **options).prepare(qp, tol)()


def assert_solved(name, qp, x=None, *, digits=1e-6):
    """Solve and verify a QP; compare the answer with x if the solution is known."""
    s = solve(name, qp)
    assert s.status is Status.SOLVED, s.message
    answer = mb.verify(qp, s.x, y=s.y, z_box=s.z_box, tol=TOL)
    assert answer.verdict.value == "verified", answer.residuals
    if x is not None:
        size = np.abs(x).max()
        assert s.x == pytest.approx(x, abs=digits * size)
        error = abs(qp.objective(s.x) - qp.objective(x))
        assert error <= 1e-8 * (abs(qp.objective(x)) + 0.5 * x @ (qp.P @ x))
    return s


@pytest.mark.parametrize("name", ON_DISCS)
def test_planted_solutions_on_discs_are_reached(name):
    for seed in range(20):
        assert_solved(name, *qp_on_discs(seed, dim=2 + seed % 2))


@pytest.mark.parametrize("name", ON_CONES)
def test_planted_solutions_on_cones_are_reached(name):
    for seed in range(20):
        assert_solved(name, *qp_on_cones(seed, dim=2 + seed % 3))


@pytest.mark.parametrize("name", ON_DISCS)
def test_discs_that_x_touches_without_a_multiplier(name):
    """Without strict complementarity, the error of x is of the order of the square
    root of the residuals.
    """
    for seed in range(100, 104):
        assert_solved(name, *qp_on_discs(seed, touching=True), digits=1e-4)


@pytest.mark.parametrize("name", ON_DISCS)
def test_radii_that_differ_by_1e8(name):
    for seed in range(200, 204):
        assert_solved(name, *qp_on_discs(seed, spread=8.0))


@pytest.mark.parametrize("name", ON_DISCS)
def test_a_disc_of_radius_zero_fixes_its_variables(name):
    P = np.array([[2.0, 1, 1], [1, 2, 1], [1, 1, 2]])
    qp = QP.from_arrays(P, [-3, 4, 5], sets=(Discs([[1, 2]], [0.0]),))
    s = assert_solved(name, qp, np.array([1.5, 0, 0]))
    assert s.z_box == pytest.approx([0, -5.5, -6.5])


@pytest.mark.parametrize("name", ON_DISCS)
def test_a_disc_of_one_variable_is_a_bound_with_the_same_counts(name):
    qp, _ = qp_on_discs(7)
    index = [[i] for i in range(qp.q.size)]
    size = np.full(qp.q.size, 0.3)
    discs = QP.from_arrays(qp.P, qp.q, sets=(Discs(index, size),))
    box = QP.from_arrays(qp.P, qp.q, lb=-size, ub=size)
    s, other = solve(name, discs), solve(name, box)
    assert [type(one) for one in discs.sets] == [Box]
    assert s.counts == other.counts
    assert (s.x == other.x).all()


@pytest.mark.parametrize("name", SMALBES)
@pytest.mark.parametrize("storage", [np.asarray, csc_array])
def test_equality_rows_beside_discs(name, storage):
    for seed in range(300, 304):
        qp, x = qp_on_discs(seed, rows=1 + seed % 3)
        assert_solved(name, replace(qp, A=storage(qp.A)), x)


def test_small_discs_beside_large_shifts():
    """The rounding error of x̃ exceeds that of the radius."""
    qp, _ = qp_on_discs(5249, dim=3, rows=3, spread=4.0)
    assert_solved("smalbe", qp)


def test_rows_that_no_point_of_the_discs_meets_are_reported():
    rows = [[1.0, 0, 0, 0], [0, 0, 1, 0]]
    qp = QP.from_arrays(
        np.eye(4), np.ones(4), A=rows, b=[2, 0], sets=(Discs([[0, 1], [2, 3]], [1, 1]),)
    )
    assert solve("smalbe", qp).status is Status.INFEASIBLE


@pytest.mark.parametrize("storage", [csc_array, aslinearoperator])
def test_a_sparse_matrix_and_an_operator_take_the_same_products(storage):
    qp, x = qp_on_discs(11)
    P = storage(qp.P)
    assert_solved("smalbe", replace(qp, P=P), x)
    s, other = solve("smalbe", qp), solve("smalbe", replace(qp, P=P))
    assert other.counts == s.counts


def test_the_unit_of_x_and_of_the_cost_changes_no_count():
    qp, _ = qp_on_discs(12)
    s = solve("smalbe", qp)
    discs = Discs(qp.sets[1].index, 2.0**-20 * qp.sets[1].radius)
    scaled = QP.from_arrays(
        2.0**30 * qp.P, 2.0**10 * qp.q, lb=2.0**-20 * qp.lb, ub=2.0**-20 * qp.ub,
        sets=(discs,),
    )  # fmt: skip
    other = solve("smalbe", scaled)
    assert other.counts == s.counts
    assert (other.x == 2.0**-20 * s.x).all()


def test_a_sequence_starts_from_the_last_point():
    qp = mindlin(88, 0.3, 0.5)
    prepare = SOLVERS["smalbe"].chain(1e-8)
    first = prepare(qp)()
    again = prepare(mindlin(88, 0.3, 0.501))()
    assert again.status is Status.SOLVED
    assert again.counts["P_products"] < first.counts["P_products"]


def test_the_history_counts_discs_that_slip():
    qp = mindlin(88, 0.3, 0.5)
    columns = solve("smalbe", qp, history=True).history
    slip = np.linalg.norm(solve("smalbe", qp).x.reshape(-1, 2), axis=1)
    slip = np.isclose(slip, qp.sets[1].radius, rtol=1e-12).sum()
    assert 0 < slip < 88
    assert columns["two_sided"][-1] == columns["active"][-1] == 2 * slip
    gradient = np.hypot(columns["free_gradient"], columns["chopped_gradient"])
    assert gradient[-1] < 1e-8 * gradient[0]


#: number of products of prototypes until the natural map is at most 1e-8, for ν = 0.3,
#: by Q/μP and number of discs
PRODUCTS = {
    "projected-gradient": {
        0.3: {88: 31, 820: 62},
        0.9: {88: 24, 820: 47},
    },
    "smalbe": {
        0.3: {88: 29, 820: 65},
        0.9: {88: 29, 820: 47},
    },
}
#: the same for MPGP
PRODUCTS_OF_MPGP = {
    0.3: {88: 63, 820: 181},
    0.9: {88: 67, 820: 164},
}
DISCS = [88, pytest.param(820, marks=pytest.mark.slow)]
#: number of products for the norm, the start and the claimed residuals, which the
#: prototypes do not count
OF_CLAIM = {"projected-gradient": 3, "smalbe": 3}


@pytest.mark.parametrize("name", PRODUCTS)
@pytest.mark.parametrize("Q", [0.3, 0.9])
@pytest.mark.parametrize("discs", DISCS)
def test_products_of_mindlins_problem(name, Q, discs):
    qp = mindlin(discs, 0.3, Q)
    s = solve(name, qp, 1e-8)
    assert s.status is Status.SOLVED
    assert natural_map(qp, s) <= 1e-8
    products = s.counts["P_products"] - OF_CLAIM[name]
    assert products <= 1.2 * PRODUCTS[name][Q][discs]


@pytest.mark.parametrize("Q", PRODUCTS_OF_MPGP)
@pytest.mark.parametrize("discs", DISCS)
def test_the_textbook_takes_the_products_of_mpgp(discs, Q):
    """The products of the norm and of the KKT residuals are not counted."""
    qp = mindlin(discs, 0.3, Q)
    s = solve("smalbe-textbook", qp, 1e-8, history=True)
    assert natural_map(qp, s) <= 1e-8
    first_run = s.history["products"][s.history["outer"] == 0]
    products = first_run[-1] - first_run[0]
    assert products == pytest.approx(PRODUCTS_OF_MPGP[Q][discs], rel=0.1)
