"""KKT residuals: violation of single conditions, and invariances."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array, vstack
from scipy.sparse.linalg import LinearOperator, aslinearoperator

from mortarbench.harness import (
    QP,
    Residuals,
    Solution,
    Status,
    Verdict,
    no_rows,
    verdict,
)
from mortarbench.harness.conformance.manufactured import manufactured
from mortarbench.harness.distributed.vectors import DistributedColumns, distributed
from mortarbench.harness.operators import SerialisableOperator
from mortarbench.harness.verify.kkt import (
    NEGLIGIBLE,
    energy_at,
    kkt_residuals,
    largest_eigenvalue,
    own_sizes,
    scales_at,
)
from mortarbench.problems.families.beam_ring import BeamRing
from mortarbench.solvers.adapters.clarabel_ import Clarabel
from mortarbench.solvers.adapters.osqp_ import OSQP
from mortarbench.solvers.adapters.proxqp_ import ProxQP
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE
from tests.support.threads import on_threads


def one_variable(q=1.0, h=0.0):
    """Return min ½x² + q·x subject to x ≤ h."""
    return QP(P=np.eye(1), q=np.array([q]), A=no_rows(1), b=np.zeros(0),
              G=np.eye(1), h=np.array([h]),
              lb=np.full(1, -np.inf), ub=np.full(1, np.inf))  # fmt: skip


def point(x, z=0.0, z_box=0.0):
    return Solution(status=Status.SOLVED, x=np.array([x]), y=np.zeros(0),
                    z=np.array([z]), z_box=np.array([z_box]))  # fmt: skip


def test_a_wrong_sign_multiplier_fails_though_the_other_residuals_vanish():
    """x = 0, z = −1 for min ½x² + x, x ≤ 0: feasible, stationary, no gap,
    but x* = −1.
    """
    r = kkt_residuals(one_variable(), point(0.0, z=-1.0))

    assert (r.primal, r.complementarity, r.gap) == (0, 0, 0)
    assert r.dual == pytest.approx(1)
    assert verdict(Status.SOLVED, r, 1e-2) is Verdict.WRONG


def test_a_multiplier_on_an_absent_bound_fails():
    r = kkt_residuals(one_variable(), point(0.0, z_box=-1.0))

    assert r.dual == pytest.approx(1)


def test_a_wrong_sign_is_measured_without_the_multipliers_of_other_rows():
    """min ½x² − x, x ≤ 0 (twice): x* = 0 with z₁ + z₂ = 1."""
    qp = replace(one_variable(q=-1.0), G=np.ones((2, 1)), h=np.zeros(2))
    s = replace(point(0.0), z=np.array([-1e-6, 1.0]))

    assert kkt_residuals(qp, s).dual == pytest.approx(1e-6)


def test_forces_at_rest_are_relative_to_the_stiffness_of_soft_variables():
    """P = ¼, x ≤ 10: the natural energy is 25, E = ¼ and √(EP) = ¼."""
    qp = replace(one_variable(q=0.0, h=99.0), P=np.eye(1) / 4, ub=np.array([10.0]))
    qp = replace(qp, G=no_rows(1), h=np.zeros(0))
    s = replace(point(0.0, z_box=-0.01), z=np.zeros(0))

    assert kkt_residuals(qp, s).dual == pytest.approx(0.04)


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_box_multiplier_pushing_outwards_fails(sign):
    """An active bound has the multiplier of the opposite bound, balanced by q."""
    qp = replace(
        one_variable(q=-sign), h=np.array([9.0]), lb=np.zeros(1), ub=np.ones(1)
    )
    at = 0.0 if sign > 0 else 1.0
    r = kkt_residuals(replace(qp, q=np.array([-sign - at])), point(at, z_box=sign))

    assert r.complementarity > 0.3  # the force acts on a bound with slack


def test_a_positive_multiplier_on_a_slack_row_is_not_complementary():
    qp = one_variable(q=-3.0, h=2.0)
    r = kkt_residuals(qp, point(1.0, z=2.0))  # stationary, but x* = 2

    assert (r.primal, r.dual) == (0, 0)
    assert r.complementarity == pytest.approx(2 / 4)  # z·slack = 2, energy hᵀz = 4
    assert r.gap == pytest.approx(2 / 4)


@pytest.mark.parametrize(
    ("broken", "expected"),
    [
        # E = xᵀPx = 2: the energy changes by E over the length √(E/P₁₁) = √2 > |x₁|
        (dict(A=np.ones((1, 2)), b=np.array([1.75])), 0.25 / (1.75 + 2 * 2**0.5)),
        (dict(A=np.ones((1, 2)), b=np.array([2.25])), 0.25 / (2.25 + 2 * 2**0.5)),
        (dict(A=np.array([[1, -1.0]]), b=np.array([0.25])),
         0.25 / (0.25 + 2 * 2**0.5)),
        (dict(G=np.ones((1, 2)), h=np.array([1.75])), 0.25 / (1.75 + 2 * 2**0.5)),
        (dict(lb=np.array([1.25, -np.inf])), 0.25 / (1.25 + 2**0.5)),
        (dict(ub=np.array([np.inf, 0.75])), 0.25 / (0.75 + 2**0.5)),
    ],
    ids=["A x > b", "A x < b", "difference", "G x > h", "x < lb", "x > ub"],
)  # fmt: skip
def test_each_violated_constraint_is_measured_relative_to_its_terms(broken, expected):
    """Each constraint is violated by ¼ at x = (1, 1)."""
    free = dict(
        P=np.eye(2), q=-np.ones(2), A=no_rows(2), b=np.zeros(0), G=no_rows(2),
        h=np.zeros(0), lb=np.full(2, -np.inf), ub=np.full(2, np.inf),
    )  # fmt: skip
    qp = QP(**free | broken)
    s = Solution(status=Status.SOLVED, x=np.ones(2), y=np.zeros(qp.b.size),
                 z=np.zeros(qp.h.size), z_box=np.zeros(2))  # fmt: skip

    assert kkt_residuals(qp, s).primal == pytest.approx(expected)


def diagonal(P, q, *, A=None, b=(), lb=-np.inf, ub=np.inf):
    q = np.asarray(q, dtype=float)
    n = q.size
    return QP(P=np.diag(np.asarray(P, dtype=float)), q=q,
              A=no_rows(n) if A is None else np.asarray(A, dtype=float),
              b=np.asarray(b, dtype=float), G=no_rows(n), h=np.zeros(0),
              lb=np.broadcast_to(lb, n).astype(float),
              ub=np.broadcast_to(ub, n).astype(float))  # fmt: skip


def at(x, y=(), z_box=(0, 0)):
    x, y, z_box = (np.asarray(v, dtype=float) for v in (x, y, z_box))
    return Solution(status=Status.SOLVED, x=x, y=y, z=np.zeros(0), z_box=z_box)


@pytest.mark.parametrize(
    ("qp", "s"),
    [
        # x₂ occurs in no term: its size must not hide that x₁ ≥ 1 or x₁ = 1 is violated
        # by 1
        (diagonal([1, 0], [0, 0], lb=[1, -np.inf]), at([0, 1e12])),
        (diagonal([1, 0], [0, 0], A=[[1, 0]], b=[1]), at([0, 1e12], [0])),
        # y and z_box cancel: their size must not hide the error of x₂ = 0, since x₂* =
        # 1
        (diagonal([0, 1], [0, -1], A=[[1, 0]], b=[0], lb=[0, -np.inf]),
         at([0, 0], [1e12], [-1e12, 0])),
        (diagonal([0, 1], [0, -1], A=[[1, 0]], b=[1], lb=[1, -np.inf], ub=[1, np.inf]),
         at([1, 100], [1e12], [-1e12, 0])),
        # |a|·|x| overflows
        (diagonal([1, 1], [0, 0], A=[[1e200, 0]], b=[1e200]), at([0, 1e200], [0])),
    ],
    ids=["bound", "row", "gradient", "energy", "overflow"],
)  # fmt: skip
def test_large_parts_of_an_answer_do_not_hide_errors_in_others(qp, s):
    assert not kkt_residuals(qp, s).worst <= 0.1


@pytest.mark.parametrize("size", [1e-9, 1e-12, -1e-12])
def test_rounding_errors_about_a_zero_solution_are_small(size):
    """min ½x² + x, x ≥ 0 has x* = 0, where all terms of the objective vanish."""
    qp = diagonal([1, 1], [1, 1], lb=0)
    s = at([size, abs(size)], z_box=[-1, -1])

    assert kkt_residuals(qp, s).worst <= 1e3 * abs(size)


@pytest.mark.parametrize("solver", [Clarabel(), OSQP(), ProxQP(), SMALBE()])
@pytest.mark.parametrize("form", ["dual", "dual-bounds", "primal"])
def test_a_load_step_without_contact_is_verified(solver, form):
    family = BeamRing()
    given = {"Nr": 4, "Nh": 3, "steps": 100, "step": 1}
    qp = family.build(form, family.complete(given), reference_solution).qp
    if solver.declines(qp):
        return

    s = solver.prepare(qp, 1e-8)()

    assert kkt_residuals(qp, s).worst <= 1e-7


@pytest.mark.parametrize("seed", [271828, 314159])
def test_a_planted_solution_has_no_residual_and_a_moved_one_has(manufactured, seed):
    qp, s = manufactured("everything", seed=seed, dense=True)

    assert kkt_residuals(qp, s).worst < 1e-13
    assert kkt_residuals(qp, replace(s, x=s.x * (1 + 1e-4))).worst > 1e-6


@pytest.mark.parametrize("seed", [271828, 314159])
def test_units_of_objective_variables_and_rows_do_not_matter(manufactured, seed):
    """Residuals are equal for objective × 2²⁰, x in units of 2⁻⁷ and scaled rows."""
    qp, s = manufactured("everything", seed=seed, dense=True)
    s = replace(s, x=s.x + 1e-3, y=s.y * 1.01, z=s.z - 1e-3, z_box=s.z_box * 0.99)
    o, u = 2.0**20, 2.0**-7
    rA, rG = 2.0 ** np.arange(-2, 3), 2.0 ** np.arange(-8, 8, 2)
    scaled = QP(
        P=qp.P * (o * u * u), q=qp.q * (o * u),
        A=rA[:, None] * qp.A * u, b=rA * qp.b, G=rG[:, None] * qp.G * u, h=rG * qp.h,
        lb=qp.lb / u, ub=qp.ub / u,
    )  # fmt: skip
    same = replace(
        s, x=s.x / u, y=s.y * o / rA, z=s.z * o / rG, z_box=s.z_box * (o * u)
    )

    assert kkt_residuals(scaled, same) == pytest.approx(kkt_residuals(qp, s), rel=1e-10)


def test_without_a_point_there_are_no_residuals(manufactured):
    qp, _ = manufactured("everything", seed=271828, dense=True)
    r = kkt_residuals(qp, Solution.without_point(qp, Status.SOLVED))

    assert np.isnan(r).all()
    assert verdict(Status.SOLVED, r, 1e-2) is Verdict.WRONG


def test_one_nan_is_enough_to_fail(manufactured):
    qp, s = manufactured("everything", seed=271828, dense=True)
    y = s.y.copy()
    y[0] = np.nan

    assert not kkt_residuals(qp, replace(s, y=y)).worst <= 1


def test_the_trivial_solution_of_a_trivial_problem_is_verified():
    assert kkt_residuals(one_variable(q=0.0), point(0.0)).worst == 0


@pytest.mark.parametrize(
    ("claimed", "worst", "expected"),
    [
        (Status.SOLVED, 9e-8, Verdict.VERIFIED),
        # the point is better than the claim
        (Status.ITERATION_LIMIT, 9e-8, Verdict.VERIFIED),
        (Status.SOLVED, 2e-7, Verdict.INACCURATE),
        (Status.SOLVED, 3e-4, Verdict.INACCURATE),  # half of the digits: √1e-7
        (Status.SOLVED, 4e-4, Verdict.WRONG),
        (Status.SOLVED, np.nan, Verdict.WRONG),
        (Status.ITERATION_LIMIT, 2e-7, Verdict.ITERATION_LIMIT),
        (Status.INFEASIBLE, np.nan, Verdict.INFEASIBLE_CLAIM),
        (Status.FAILED, np.nan, Verdict.FAILED),
        (Status.DECLINED, 0.0, Verdict.DECLINED),
    ],
)
def test_the_verdict_follows_from_the_residuals_at_tol_1e_8(claimed, worst, expected):
    assert verdict(claimed, Residuals(0, worst, 0, 0), 1e-8) is expected


def test_a_claim_of_infeasibility_is_verified_by_a_proof_only():
    none = Residuals(*[np.nan] * 4)

    found = [verdict(Status.INFEASIBLE, none, 1e-8, infeasible=v) for v in (1, 0)]
    assert found == [Verdict.VERIFIED_INFEASIBLE, Verdict.INFEASIBLE_CLAIM]


def test_a_loose_tolerance_does_not_verify_a_refutation():
    assert verdict(Status.SOLVED, Residuals(0, 1.0, 0, 0), 0.5) is Verdict.WRONG
    assert verdict(Status.SOLVED, Residuals(0, 0.05, 0, 0), 0.5) is Verdict.VERIFIED


@pytest.mark.parametrize("unit", [2.0**-20, 2.0**20])
def test_verdicts_for_an_operator_do_not_depend_on_units(manufactured, unit):
    qp, s = manufactured("everything", seed=314159, dense=True)
    moved = replace(s, x=s.x + 1e-3)

    def operator_in(unit):
        return replace(
            qp, P=aslinearoperator(qp.P * unit**2), q=qp.q * unit, A=qp.A * unit,
            G=qp.G * unit, lb=qp.lb / unit, ub=qp.ub / unit,
        )  # fmt: skip

    same = replace(moved, x=moved.x / unit, z_box=moved.z_box * unit)
    found = kkt_residuals(operator_in(unit), same)

    assert found == pytest.approx(kkt_residuals(operator_in(1.0), moved), rel=1e-9)


def test_an_operator_without_diagonal_has_similar_residuals_to_its_matrix(
    manufactured,
):
    """Lengths depend on Pᵢᵢ, so primal and dual residuals differ without a diagonal."""
    qp, s = manufactured("everything", seed=314159, dense=True)
    moved = replace(s, x=s.x + 1e-3)
    one = kkt_residuals(qp, moved)
    other = kkt_residuals(replace(qp, P=aslinearoperator(qp.P)), moved)

    assert (other.complementarity, other.gap) == (one.complementarity, one.gap)
    assert other.primal == pytest.approx(one.primal, rel=10)
    assert 0.1 <= other.dual / one.dual <= 10


def test_an_operator_with_diagonal_has_the_residuals_of_its_matrix(manufactured):
    qp, s = manufactured("everything", seed=314159, dense=True)

    class Telling:
        def __call__(self, x):
            return qp.P @ x

        def diagonal(self):
            return qp.P.diagonal()

    P = SerialisableOperator(qp.q.size, "telling", {}, {"telling": lambda _: Telling()})
    silent = SerialisableOperator(
        qp.q.size, "silent", {}, {"silent": lambda _: Telling().__call__}
    )
    moved = replace(s, x=s.x + 1e-3)
    found = kkt_residuals(replace(qp, P=P), moved)

    assert found == pytest.approx(kkt_residuals(qp, moved), rel=1e-12)
    assert replace(qp, P=silent).diagonal() is None
    assert replace(qp, P=aslinearoperator(qp.P)).diagonal() is None


def test_a_row_without_entries_does_not_inflate_the_scale_of_x():
    qp, s = manufactured("inequalities")
    n = qp.q.size
    empty = replace(
        qp, G=vstack([csr_array(qp.G), csr_array((1, n))]), h=np.append(qp.h, 3.0)
    )
    point = replace(s, x=s.x * (1 + 1e-15), z=np.append(s.z, 0.0))
    assert kkt_residuals(empty, point).worst < 1e-13


def test_rounding_in_products_with_an_operator_does_not_refute_an_answer():
    """min ½x₁² − x₁ at its minimum; x₂ is arbitrary."""

    def product(x):
        return np.array([x[0], 2.0**-52 * x[0]])

    P = LinearOperator((2, 2), matvec=product, dtype=float)
    qp = replace(diagonal([0, 0], [-1, 0]), P=P)

    residuals = kkt_residuals(qp, at([1, 1e8]))

    assert residuals.dual == 0
    assert verdict(Status.SOLVED, residuals, 1e-8) is Verdict.VERIFIED


@pytest.mark.parametrize(
    ("qp", "expected"),
    [
        (diagonal([1], [-1]), 1 / 2),  # |½x² − x| at x = 1
        (diagonal([4], [-1]), 1 / 8),
        (diagonal([0.25], [-1]), 2),  # at x = 4
        (diagonal([1], [-1], ub=10), 1 / 2),
        (diagonal([1], [-1], ub=0.5), 3 / 8),  # at x = ½
        (diagonal([1], [0], ub=10), 100),  # no cost: Pl² over the length of the bound
        (diagonal([1, 4], [-1, -1]), 1 / 8),  # the smallest
    ],
)
def test_the_least_energy_scale_is_a_hundredth_of_the_gain_of_one_variable(
    qp, expected
):
    nowhere = at(0 * qp.q, z_box=0 * qp.q)
    with np.errstate(invalid="ignore"):  # 0·∞ for absent bounds
        found = energy_at(qp, nowhere)

    assert found == pytest.approx(expected / 100)


def test_the_generous_energy_scale_is_the_lower_median_of_the_gains():
    """The gains q²/2P of the variables are ½, ⅛ and 1/32."""
    for bends, expected in (([1], 1 / 2), ([1, 4], 1 / 8), ([1, 4, 16], 1 / 8)):
        qp = diagonal(bends, [-1] * len(bends))
        nowhere = at(0 * qp.q, z_box=0 * qp.q)
        with np.errstate(invalid="ignore"):  # 0·∞ for absent bounds
            found = energy_at(qp, nowhere, generous=True)

        assert found == pytest.approx(expected)


@pytest.mark.parametrize("unit", [2.0**-20, 1.0, 2.0**20])
def test_multipliers_that_cancel_hide_a_gap_of_at_most_a_small_fraction(unit):
    """min ½x², x = 1 (twice): the multipliers −2³⁹ − 1 − δ and 2³⁹ leave a gap of δ.

    The rounding of their sum, 2e-3, exceeds δ = 2⁻¹⁰, but is not subtracted entirely.
    """
    gap = 2.0**-10
    qp = diagonal([unit], [0], A=[[1], [1]], b=[1, 1])
    s = at([1], [-unit * (2.0**39 + 1 + gap), unit * 2.0**39], z_box=[0])

    expected = gap / (1 + gap) - NEGLIGIBLE
    assert kkt_residuals(qp, s).gap == pytest.approx(expected, rel=1e-9)


def test_only_active_rows_define_the_sizes_of_idle_variables():
    """x₁ + x₂ ≤ 100 is active up to a slack of 2e-4 · 200."""
    qp = replace(
        diagonal([1, 0], [-100, 0]), G=np.array([[1.0, 1.0]]), h=np.array([100.0])
    )

    for x, size in ((-0.01, 200), (-1.0, 1)):
        sizes = scales_at(qp, np.array([100, x]), 1e4).x
        assert sizes == pytest.approx([100, size])


def test_sizes_of_variables_are_positive():
    assert (own_sizes(diagonal([1, 1], [0, 0]), np.array([-1.0, 2])) == [10, 20]).all()


@pytest.mark.parametrize("d", [0, 4])
def test_the_largest_eigenvalue_may_be_zero(d):
    assert largest_eigenvalue(diagonal([0, d], [1, 1])) == pytest.approx(d)


class Diagonal:
    """Diagonal P of a QP with distributed vectors."""

    def __init__(self, d):
        self.d, self.shape = d, (d.size, d.size)

    def __matmul__(self, x):
        return self.d * x

    def diagonal(self):
        return self.d


def test_a_rank_without_bounds_takes_part_in_the_residuals():
    """The last of three ranks has 3 of 9 variables, all without bounds."""
    rng = np.random.default_rng(5)
    d, q, x, z = 1 + rng.random((4, 9))
    lb = np.where(np.arange(9) < 6, 0.5, -np.inf)
    ub = np.where(np.arange(9) < 3, 1.1, np.inf)

    def residuals(ranks=None):
        own = (
            slice(None) if ranks is None else slice(3 * ranks.rank, 3 * ranks.rank + 3)
        )

        def part(v):
            return v[own] if ranks is None else distributed(v[own], ranks)

        n = part(d).size
        none = no_rows(n) if ranks is None else DistributedColumns(no_rows(n), ranks)
        qp = QP(
            P=Diagonal(part(d)), q=part(q), A=none, b=np.zeros(0), G=none,
            h=np.zeros(0), lb=part(lb), ub=part(ub),
        )  # fmt: skip
        s = Solution(
            status=Status.SOLVED, x=part(x), y=np.zeros(0), z=np.zeros(0),
            z_box=part(z),
        )  # fmt: skip
        return kkt_residuals(qp, s)

    alone = residuals()
    assert alone.primal > 1e-3
    for there in on_threads(3, residuals):
        assert there == pytest.approx(alone, rel=1e-13)
