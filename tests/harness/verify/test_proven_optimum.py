"""Verdicts by proven optima, tested with wrong and right answers."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from scipy.sparse import csr_array, eye_array

from mortarbench.harness import (
    QP,
    Solution,
    Status,
    Verdict,
    no_rows,
    verdict,
)
from mortarbench.harness.record import Record
from mortarbench.harness.verify.kkt import (
    ROUNDING,
    Residuals,
    kkt_residuals,
    rejudged,
    tightened,
)
from mortarbench.harness.verify.optimum import (
    coupled,
    decided,
    error_at,
    exact_optimum,
    exact_optimum_without_guess,
    is_small,
    proven_optimum,
    proves,
)
from mortarbench.harness.verify.verdicts import judged
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.hard_qps import KINDS, hard

TOL = 1e-8
INF = np.inf


def qp_of(P, q, *, A=None, b=(), G=None, h=(), lb=-INF, ub=INF):
    """Return a QP from nested lists; a flat list defines a diagonal P."""
    n, P = len(q), np.array(P, dtype=float)
    rows = [no_rows(n) if M is None else np.array(M, dtype=float) for M in (A, G)]
    lb, ub = (np.array(np.broadcast_to(v, n), dtype=float) for v in (lb, ub))
    q, b, h = (np.array(v, dtype=float) for v in (q, b, h))
    P = np.diag(P) if P.ndim == 1 else P
    return QP(P=P, q=q, A=rows[0], b=b, G=rows[1], h=h, lb=lb, ub=ub)


def at(x, y=(), z=(), z_box=None):
    x, y, z = (np.array(v, dtype=float) for v in (x, y, z))
    z_box = np.zeros(x.size) if z_box is None else np.array(z_box, dtype=float)
    return Solution(status=Status.SOLVED, x=x, y=y, z=z, z_box=z_box)


def judge(qp, s, tol=TOL):
    return verdict(Status.SOLVED, kkt_residuals(qp, s), tol)


FAR = qp_of([1, 1], [-1, -1], A=[[1, 1]], b=[1], ub=1e7)  # x* = (½, ½), f* = −¾
FLAT = qp_of([1e-9] * 5, [1, 2, 3, 4, 5], A=[[1] * 5], b=[1], lb=0)  # x* = e₁, f* = 1
HIDDEN = qp_of([1, 1], [0, 0], G=[[0, 1e-12]], h=[1], lb=[1, -INF])  # (1, 0), ½
AS_ROW = qp_of([1, 1], [0, 0], G=[[-1, 0], [0, 1e-12]], h=[-1, 1])  # (1, 0), ½
COSTLY = qp_of([1, 1], [1e9, -1], lb=[0, -INF], ub=[1, INF])  # (0, 1), −½
LONG = qp_of([1, 0, 0], [0, 0, 0], A=[[1, 1, -1], [0, 1, -1]], b=[1, 0])  # x₁ = 1, ½
PAID = replace(LONG, q=np.array([0.0, 1, -1]))  # x₁ = 1, ½, since x₂ = x₃
UNITS = qp_of([1, 1e16], [-1, 0], lb=[-INF, 1e-8])  # (1, 1e-8), f* = 0


# comments state the objective at the point, and f*
@pytest.mark.parametrize(
    ("qp", "s"),
    [
        (FAR, at([1, 1], [0])),  # −1 for −¾: the row is violated by 1
        (FAR, at([0, 0], [1])),  # 0 for −¾, and stationary
        (FLAT, at([0] * 5, [0])),  # 0 for 1
        (FLAT, at([0] * 5, [-1], z_box=[0, -1, -2, -3, -4])),
        (FLAT, at([0, 0, 0, 0, 1], [-1], z_box=[0, -1, -2, -3, -4])),  # 5 for 1
        (FLAT, at([0, 0, 0, 0, 1], [-5], z_box=[4, 3, 2, 1, 0])),
        (FLAT, at([0, 0, 0, 0, 1], [-3], z_box=[0, 0, 0, 0, 0])),
        (HIDDEN, at([0, 0], z=[0])),  # 0 for ½
        (HIDDEN, at([0, 1e12], z=[0])),
        (AS_ROW, at([0, 0], z=[0, 0])),
        (AS_ROW, at([0, 0], z=[1, 0])),
        (COSTLY, at([0, 0], z_box=[-1e9, 0])),  # 0 for −½
        (COSTLY, at([1e-9, 1], z_box=[-1e9, 0])),  # ½ for −½
        (LONG, at([0, 1e12, 1e12], [0, 0])),  # 0 for ½
        (LONG, at([0, 1e12, 1e12], [-1, 1])),
        (PAID, at([0, 1e12, 1e12], [0, -1])),
        (PAID, at([0.5, 1e12, 1e12], [-0.5, -0.5])),
        (UNITS, at([1, 0])),  # below its bound by the entire bound
    ],
)
def test_a_wrong_point_is_refuted_by_residuals(qp, s):
    assert judge(qp, s) is Verdict.WRONG
    assert judge(qp, s, 1e-3) is not Verdict.VERIFIED


TINY = 6e-13  #: ½x² + ½x² = 4e-25


@pytest.mark.parametrize(
    ("qp", "s"),
    [
        (FAR, at([0.5, 0.5], [0.5])),
        (FLAT, at([1, 0, 0, 0, 0], [-1 - 1e-9], z_box=[0, -1, -2, -3, -4])),
        (COSTLY, at([0, 1], z_box=[-1e9, 0])),
        (LONG, at([1, 1e12, 1e12], [-1, 1])),
        (PAID, at([1, 1e12, 1e12], [-1, 0])),
        (LONG, at([1, 0, 0], [-1, 1])),
        (qp_of([1, 1], [0, 0], ub=1), at([TINY, TINY])),
        (qp_of([1, 1], [0, 0], lb=0), at([TINY, TINY])),
        (qp_of([1, 1], [0, 0]), at([TINY, TINY])),
        (qp_of([1, 1], [0, 0], A=[[1, -1]], b=[0]), at([TINY, TINY], [0])),
        (qp_of([1, 1], [0, 0], G=[[1, 1]], h=[5]), at([TINY, TINY], z=[0])),
        (qp_of([1, 1], [1e-17, -3e-17], lb=0, ub=3), at([TINY, TINY])),
        # a gradient of 1e-9 with a noise of 1e-10, together with a gradient of 1
        (qp_of([1, 1], [-1, -1e-9]), at([1, 9e-10])),
        # x₂ is at its bound, whose multiplier of 1e-9 is missing
        (qp_of([1, 0], [-1, 1e-9], lb=[-INF, 75]), at([1, 75])),
        (qp_of([1, 0], [-1, -1e-9], ub=[INF, -75]), at([1, -75])),
        (qp_of([1, 0], [-1e-6, 1e-15], lb=[-INF, 0]), at([1e-6, 0])),
    ],
)
def test_a_right_point_is_verified_by_its_residuals(qp, s):
    assert judge(qp, s) is Verdict.VERIFIED


def test_without_cost_a_point_far_from_zero_is_still_wrong():
    assert judge(qp_of([1, 1], [0, 0], ub=1), at([1e-2, 1e-2])) is Verdict.WRONG


def test_rows_tighten_the_widths_of_variables():
    """x₁ + x₂ = 1, x ≥ 0 implies xᵢ ≤ 1.

    2x₁ − x₃ ≤ 4, x₁ ≥ −1, x₃ ≤ 6 implies x₁ ≤ 5, x₃ ≥ −6.
    """
    simplex = qp_of([1, 1], [0, 0], A=[[1, 1]], b=[1], lb=0)
    open_ended = qp_of(
        [1, 1, 1], [0] * 3, G=[[2, 0, -1]], h=[4], lb=[-1, 0, -INF], ub=[INF, INF, 6]
    )

    for qp, widths in ((simplex, [1, 1]), (open_ended, [6, INF, 12])):
        lb, ub = tightened(qp)
        assert ub - lb == pytest.approx(widths)


#: the rows x₂ ≤ 0 and δx₁ + x₂ ≥ 0 imply x* = (0, 0), f* = 0
DELTA = 2.0**-34
NEARLY = qp_of([1, 1], [0.5, 0], G=[[0, 1], [-DELTA, -1]], h=[0, 0])
BETWEEN = at([-0.5, DELTA / 4], z=[0, 0])  # violates both by δ/4; f = −0.125
#: the same problem, shifted by (1.5, 0); the right-hand side of the second row defines
#: its scale
MOVED = qp_of([1, 1], [-1, 0], G=[[0, 1], [-DELTA, -1]], h=[0, -1.5 * DELTA])

#: curvature 4ε along (1, −1), where the slope at (½, ½) is 2γ: f* = −½ − γ²/2ε = −1
EPSILON, GAMMA = 2.0**-50, 2.0**-25
WEAK = qp_of(
    [[1 + EPSILON, 1 - EPSILON], [1 - EPSILON, 1 + EPSILON]], [-1 - GAMMA, -1 + GAMMA]
)
SHORT = at([0.5, 0.5])  # f = −½


def test_residuals_refute_no_point_between_nearly_parallel_rows():
    """Rational arithmetic proves f* = 0 from a reference point with the same error."""
    assert kkt_residuals(NEARLY, BETWEEN).worst <= 1e-9
    optimum = proven_optimum(NEARLY, lambda _: BETWEEN)

    assert optimum is not None
    assert optimum.value == 0
    assert error_at(BETWEEN, optimum) > 1e-4


@pytest.mark.parametrize("angle", [0.3, 1.0, 2.5])
def test_a_weak_oblique_direction_is_resolved_exactly_without_a_reference(angle):
    """P has curvature 1e-16 along a direction of slope 1e-8, rotated and rounded."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    P = turn @ np.diag([1, 1e-16]) @ turn.T
    qp = qp_of((P + P.T) / 2, turn @ [1, 1e-8])
    (a, b), (_, d) = ([Fraction(v) for v in row] for row in qp.P)
    p, q = map(Fraction, qp.q)
    value = -(d * p * p - 2 * b * p * q + a * q * q) / (a * d - b * b) / 2
    assert a * d > b * b  # in the stored numbers; otherwise, the QP is unbounded
    s = at(turn @ [-1, 0])
    error = decided(qp, s, kkt_residuals(qp, s), TOL, proves(reference_solution))

    assert value < -0.6  # f = −0.5 at the point
    assert error is not None
    assert error > 1e-4


def test_a_row_with_a_right_hand_side_is_judged_relative_to_its_terms():
    moved = replace(BETWEEN, x=BETWEEN.x + np.array([1.5, 0]))

    assert judge(MOVED, moved, 1e-4) is not Verdict.VERIFIED


def test_a_refutation_by_the_reference_is_recorded():
    assert kkt_residuals(WEAK, SHORT).worst <= 10 * TOL

    measured = judged(new_record(), WEAK, SHORT, proves(reference_solution))

    assert measured.verdict is Verdict.WRONG
    assert measured.decided_by == "reference"
    assert measured.optimum_error == pytest.approx(0.025, rel=1e-3)  # ½ of 10·E, E = 2
    again = Record.from_json(measured.to_json())
    assert rejudged(again, 10) is Verdict.WRONG
    assert rejudged(again, 1e9) is Verdict.VERIFIED  # at 0.1


def new_record(**changes):
    return Record(
        run_id="r", case="c/f", family="c", params={}, form="f", sizes={}, solver="s",
        options={}, tol=TOL, repeat=0, block=0, verdict=Verdict.FAILED, **changes,
    )  # fmt: skip


@pytest.mark.parametrize(("accuracy", "expected"), [(1e-2, True), (1e-8, False)])
def test_an_answer_is_judged_at_the_accuracy_that_is_not_its_tolerance(
    accuracy, expected
):
    """For min ½x² − x, x = 1.001 has a residual of 1e-3."""
    s = at([1.001])
    measured = judged(new_record(accuracy=accuracy), qp_of([1], [-1]), s)

    assert (measured.verdict is Verdict.VERIFIED) is expected
    assert measured.decided_by == "residuals"


@pytest.mark.parametrize("name", ["x", "y", "z", "z_box"])
def test_a_point_with_nan_anywhere_is_not_verified_by_a_reference(name):
    qp = qp_of([1, 1], [-1, 0], A=[[0, 1]], b=[0], G=[[1, 1]], h=[5], lb=0)
    s = at([1, 0], [0], z=[0])
    broken = replace(s, **{name: np.full_like(getattr(s, name), np.nan)})
    assert judge(qp, s) is Verdict.VERIFIED

    measured = judged(new_record(), qp, broken, proves(reference_solution))

    assert measured.verdict is Verdict.WRONG


def test_if_the_reference_fails_residuals_decide():
    def fails(_):
        raise ArithmeticError

    qp = qp_of(np.eye(MANY) + 1, [-1] * MANY)  # too large for rational arithmetic
    s = at([1 / (MANY + 1)] * MANY)

    assert decided(qp, s, kkt_residuals(qp, s), TOL, proves(fails)) is None


def test_a_false_reference_does_not_change_the_optimum():
    for qp, s, value in (
        (FAR, at([1, 1], [0]), -0.75), (COSTLY, at([0, 0], z_box=[-1e9, 0]), -0.5),
    ):  # fmt: skip
        optimum = proven_optimum(qp, lambda _, s=s: s)
        assert optimum is not None
        assert optimum.value == value


CANCELLED = (  # f* = 2⁻²⁰ between terms of 50 to 1400; some multipliers are not unique
    (("big-M", "cancelled", "fixed"), 878510873),
    (("cancelled", "duplicates", "redundant"), 716254695),
    (("cancelled", "far bounds", "free direction"), 360818169),
    (("cancelled", "fixed", "redundant"), 879083487),
    (("cancelled", "duplicates", "redundant"), 194299169),
)


@pytest.mark.parametrize(
    ("kinds", "number"),
    [
        *CANCELLED[:2],
        *(pytest.param(*one, marks=pytest.mark.slow) for one in CANCELLED[2:]),
    ],
)
def test_cancelling_terms_are_evaluated_exactly(kinds, number):
    planted = hard(frozenset(kinds), number)
    attack = Attack(planted, np.random.default_rng(1))

    exact = exact_optimum(planted.qp, reference_solution(planted.qp))
    assert exact is not None
    assert exact.value == 2.0**-20
    passed = [s for s in attack.points(100) if attack.verified(s)]
    assert passed
    assert max(attack.error(s) for s in passed) <= 1e-3
    assert all(attack.verified(attack.rounded()) for _ in range(5))


def test_a_non_optimal_point_has_no_exact_value():
    qp = qp_of(np.eye(2), [-1, -1], A=[[1, 1]], b=[1], ub=[1e7, 1e7])
    right, wrong = at([0.5, 0.5], [0.5]), at([1e7, 0], [0], z_box=[1, 0])

    exact = exact_optimum(qp, right)
    assert exact is not None
    assert exact.value == Fraction(-3, 4)
    # the multiplier of the bound would have the wrong sign
    assert exact_optimum(qp, wrong) is None


BOUNDED = qp_of([1], [1], lb=0)  # x* = 0


@pytest.mark.parametrize(
    ("qp", "s"),
    [
        (BOUNDED, at([-1])),
        (qp_of([1], [-1], ub=0), at([1])),
        (qp_of([1], [-1], G=[[1]], h=[0]), at([1], z=[0])),
        (qp_of([1], [1], G=[[1]], h=[0]), at([0], z=[1])),  # x* = −1: wrong sign of z
        (qp_of([1], [-1], lb=0), at([0], z_box=[-1])),  # x* = 1: wrong sign of z_box
        (qp_of([1, 1], [0, 0], A=[[1, 0], [1, 0]], b=[1, 2]), at([1, 0], [0, 0])),
    ],
    ids=["x < lb", "x > ub", "G x > h", "z < 0", "z_box > 0 at lb", "infeasible"],
)
def test_a_point_that_breaks_one_condition_has_no_exact_value(qp, s):
    assert exact_optimum(qp, s) is None


def test_a_point_at_its_bound_has_an_exact_value():
    exact = exact_optimum(BOUNDED, at([0], z_box=[-1]))

    assert exact is not None
    assert (exact.value, exact.solution.z_box) == (0, [-1])


def test_the_optimum_of_a_well_conditioned_qp_is_known_to_fourteen_digits():
    optimum = proven_optimum(FAR, reference_solution)

    assert optimum is not None
    assert optimum.value == pytest.approx(-3 / 4, rel=1e-14)
    assert optimum.doubt <= 1e-14


MANY = 45  #: number of variables, too large for rational arithmetic


@pytest.mark.parametrize("unit", [2.0**-60, 1.0, 2.0**60])
def test_multipliers_that_cancel_prove_nothing_in_any_unit_of_energy(unit):
    """Two rows Σxⱼ = n/2 with multipliers of 5e11 balance q only to 1e-4."""
    row = np.ones((2, MANY))
    qp = qp_of([unit] * MANY, [-unit] * MANY, A=row, b=[MANY / 2] * 2)
    off = 2.0**39 + 0.5 + 2.0**-13

    def found(y):
        return at([0.5] * MANY, unit * np.array(y))

    assert proven_optimum(qp, lambda _: found([off, -(2.0**39)])) is None
    optimum = proven_optimum(qp, lambda _: found([0.5, 0]))
    assert optimum is not None
    assert optimum.value == -MANY * 3 / 8 * unit


def test_active_sets_that_recur_prove_nothing():
    """The active sets 111, 101, 110 of the rows form a cycle."""
    P = [[16, 1, -7, 6], [1, 8, 1, 0], [-7, 1, 6, -4], [6, 0, -4, 7]]
    G = [[3, -2, -3, 1], [-1, -3, 0, 2], [-3, 0, -2, 1]]
    qp = qp_of(P, [3, 3, 3, -2], G=G, h=[1, 1, 2], lb=-1)

    assert exact_optimum_without_guess(qp) is None
    known = exact_optimum(qp, reference_solution(qp))
    assert known is not None
    assert known.value < 0


@pytest.mark.parametrize("coupling", [0, 1])
@pytest.mark.parametrize("sign", [1, -1])
def test_multipliers_that_cancel_leave_no_doubt_of_an_exact_point(sign, coupling):
    """x₁ + x₂ = 2 (twice) and x₁ = x₂: the least multipliers are used.

    If P couples all variables, they are too many for rational arithmetic.
    """
    A = np.zeros((3, MANY))
    A[:, :2] = sign * np.array([[1, 1], [1, 1], [1, -1]])
    q = np.full(MANY, -2.0 * coupling)
    q[:2] -= 1, 3
    qp = qp_of(np.eye(MANY) + coupling, q, A=A, b=[sign * 2, sign * 2, 0])
    x = np.where(np.arange(MANY) < 2, 1.0, 0.0)
    y = sign * np.array([1 + 2.0**40, -(2.0**40), -1])

    optimum = proven_optimum(qp, lambda _: at(x, y))

    assert optimum is not None
    assert optimum.value == -3 - 2 * coupling
    assert optimum.doubt <= 1e-13


def test_a_multiplier_of_a_bound_balances_the_gradient_in_a_proof():
    """x* = (0, 1, …, 1) for many coupled variables; the bound x₁ ≥ 0 has z_box = −1."""
    P, x, pull = np.eye(MANY) + 1, np.ones(MANY), np.zeros(MANY)
    x[0], pull[0] = 0, -1
    qp = qp_of(P, -(P @ x) - pull, lb=0)

    optimum = proven_optimum(qp, lambda _: at(x, z_box=pull))

    assert optimum is not None
    assert optimum.value == -(MANY - 1) * MANY / 2
    assert optimum.doubt <= 1e-10


def test_an_objective_without_terms_has_no_scale():
    assert proven_optimum(qp_of([0], [0]), lambda _: at([0])) is None


def test_variables_are_coupled_by_entries_other_than_zero():
    """x₁ and x₂ are coupled by P, x₅ by a row; stored zeros couple no variables."""
    row, column = [0, 0, 1, 1, 2, 3], [0, 1, 0, 1, 3, 2]
    P = csr_array(([2.0, 1, 1, 2, 0, 0], (row, column)), shape=(5, 5))
    qp = replace(qp_of([0] * 5, [0] * 5, A=[[0, 0, 0, 0, 1]], b=[1]), P=P)

    assert P.nnz == 6
    assert coupled(qp).tolist() == [True, True, False, False, True]


@pytest.mark.parametrize(("rows", "expected"), [(0, True), (1, False)])
def test_a_qp_is_small_up_to_400_variables_and_rows(rows, expected):
    qp = qp_of([1] * 400, [0] * 400, A=np.ones((rows, 400)), b=[0] * rows)

    assert is_small(qp) is expected


@pytest.mark.parametrize(("n", "expected"), [(4000, True), (4001, False)])
def test_uncoupled_variables_may_be_ten_times_as_many(n, expected):
    assert is_small(replace(qp_of([1], [0]), **vectors(n), P=eye_array(n))) is expected


@pytest.mark.parametrize(("n", "expected"), [(799, True), (800, False)])
def test_an_operator_is_small_up_to_800_variables_and_rows(n, expected):
    row = dict(A=np.ones((1, n)), b=np.zeros(1))
    qp = replace(qp_of([1], [0]), P=Products(eye_array(n)), **vectors(n) | row)

    assert is_small(qp) is expected


def vectors(n):
    return dict(
        q=np.zeros(n), A=no_rows(n), G=no_rows(n), lb=np.full(n, -INF),
        ub=np.full(n, INF),
    )  # fmt: skip


def test_a_remote_reference_point_hides_no_error():
    """Terms are 1e24 at a solution that is 1e10 away along the free direction x₁ = −x₃;
    f* = 2⁻²⁰.
    """
    planted = hard(frozenset({"cancelled", "duplicates", "redundant"}), 194299169)
    qp, s = planted.qp, planted.solution
    free = np.array([1.0, 0, -1, 0])
    assert not any((M @ free).any() for M in (qp.P, qp.A, qp.G[:2], qp.q[None]))

    long = replace(s, x=s.x + 2.0**33 * free)
    optimum = proven_optimum(qp, lambda _: long)

    assert optimum is not None
    assert optimum.value == 2.0**-20
    assert optimum.doubt <= 1e-3 * 2.0**-20
    assert optimum.energy <= 1e4 * 2.0**-20


#: x* = (½, ½, ½), f* = 1.5; within its bounds, each variable could gain 1e12
WIDE = qp_of(
    [0] * 3, [1] * 3, G=[[-1, -1, 0], [0, -1, -1], [-1, 0, -1]], h=[-1] * 3,
    lb=-1e12, ub=1e12,
)  # fmt: skip
#: x* = (0, 0, 1), f* = −½; without bounds, each of x₁, x₂ could gain 1e12
PUSHED = qp_of([1] * 3, [1e6, 1e6, -1], lb=[0, 0, -INF])
#: x* = (−3, 3.5), f* = −1.2e10; the multiplier of the row is negligible
BESIDE = qp_of([0, 0], [4e9, 1], A=[[0, 1]], b=[3.5], lb=[-3, -INF])


@pytest.mark.parametrize(
    ("qp", "right", "wrong", "tol"),
    [
        (WIDE, at([0.5] * 3, z=[0.5] * 3), at([2] * 3, z=[0.5] * 3), 1e-4),  # 6
        (PUSHED, at([0, 0, 1], z_box=[-1e6, -1e6, 0]),
         at([0, 0, -1], z_box=[-1e6, -1e6, 0]), 1e-4),  # 1.5
        (BESIDE, at([-3, 3.5], [-1], z_box=[-4e9, 0]),
         at([-3, 5.5], [-1], z_box=[-4e9, 0]), TOL),
    ],
    ids=["far bounds", "other variables", "other rows"],
)  # fmt: skip
def test_large_terms_do_not_hide_small_violations(qp, right, wrong, tol):
    def verified(s, tol):
        residuals = kkt_residuals(qp, s)
        error = decided(qp, s, residuals, tol, proves(reference_solution))
        return verdict(Status.SOLVED, residuals, tol, error=error) is Verdict.VERIFIED

    assert verified(right, TOL)
    assert not verified(wrong, tol)


def test_remote_bounds_hide_no_error_if_residuals_decide():
    s = at([2] * 3, z=[0.5] * 3)  # 6 for 1.5

    assert kkt_residuals(WIDE, s, generous=True).worst > 0.1


def test_a_cancelling_objective_is_accurate_relative_to_its_terms():
    """min ½x², x = 1, with a fixed variable of cost −½: f* = 0, terms of ½."""
    qp = qp_of([1, 0], [0, -0.5], A=[[1, 0]], b=[1], lb=[-INF, 1], ub=[INF, 1])
    s = at([1 + 1e-9, 1], [-1 - 1e-9], z_box=[0, 0.5])

    error = decided(qp, s, kkt_residuals(qp, s), TOL, proves(reference_solution))

    assert error == pytest.approx(1e-9, rel=3)
    further = at([1 + 4e-9, 1], [-1 - 4e-9], z_box=[0, 0.5])
    residuals = kkt_residuals(qp, further)
    assert residuals.worst > 10 * TOL  # relative to f; hence the optimum decides
    error = decided(qp, further, residuals, TOL, proves(reference_solution))
    assert error == pytest.approx(4e-9, rel=3)
    assert judge(qp, at([1, 1], [-1], z_box=[0, 0.5])) is Verdict.VERIFIED


def test_the_verdict_at_another_factor_is_that_of_the_error_to_the_optimum():
    stored = new_record(decided_by="reference", optimum_error=5e-8).replace(
        claimed="solved", primal=1e-6, dual=0.0, complementarity=0.0, gap=0.0,
        verdict=verdict(Status.SOLVED, Residuals(1e-6, 0, 0, 0), TOL, error=5e-8),
    )  # fmt: skip

    assert stored.verdict is Verdict.VERIFIED
    assert rejudged(stored, 10) is Verdict.VERIFIED
    assert rejudged(stored, 1) is Verdict.INACCURATE


def test_without_a_reference_the_verdict_at_another_factor_is_that_of_the_residuals():
    found = dict(claimed="solved", primal=5e-8, dual=0.0, complementarity=0.0, gap=0.0)
    stored = new_record().replace(**found, verdict=Verdict.VERIFIED)

    assert rejudged(stored, 10) is Verdict.VERIFIED
    assert rejudged(stored, 1) is Verdict.INACCURATE


def test_without_a_point_the_verdict_is_the_same_at_every_factor():
    stored = new_record().replace(claimed="solved", verdict=Verdict.WRONG)

    assert rejudged(stored, 1e9) is Verdict.WRONG


@pytest.mark.parametrize("kind", ["plain", *KINDS])
def test_planted_points_are_solutions_to_the_last_digit(kind):
    for seed in range(5):
        planted = hard(frozenset({kind} & set(KINDS)), seed)
        qp, s = planted.qp, planted.solution

        force = qp.P @ s.x + qp.q + qp.A.T @ s.y + qp.G.T @ s.z + s.z_box
        assert not force.any()
        assert (qp.A @ s.x == qp.b).all()
        assert (qp.G @ s.x <= qp.h).all()
        assert (s.z * (qp.h - qp.G @ s.x) == 0).all()
        assert (s.z >= 0).all()
        assert ((qp.lb <= s.x) & (s.x <= qp.ub)).all()
        assert ((s.z_box >= 0) | (s.x == qp.lb)).all()
        assert ((s.z_box <= 0) | (s.x == qp.ub)).all()


# --- the search: points near and far from planted solutions ---------------------------


class Products:
    """Operator P that provides only products."""

    def __init__(self, P):
        self.P, self.shape, self.dtype = P, P.shape, P.dtype

    def __matmul__(self, x):
        return self.P @ x


def with_idle(qp, rng, count):
    """Append variables without cost, with or without curvature and bounds."""
    n = qp.q.size
    bends = np.ldexp(1.0, rng.integers(-30, 31, rng.choice([1, count])))
    P = np.pad(qp.P, (0, count))
    P[range(n, n + count), range(n, n + count)] = bends * rng.integers(0, 2)
    A, G = (np.pad(M, ((0, 0), (0, count))) for M in (qp.A, qp.G))
    far = np.full(count, rng.choice([1.0, INF]))
    return replace(
        qp, P=P, q=np.pad(qp.q, (0, count)), A=A, G=G,
        lb=np.append(qp.lb, -far), ub=np.append(qp.ub, far),
    )  # fmt: skip


#: variants of a planted QP: number of further variables, and P as an operator or not
WAYS = {"as it is": (0, False), "400 idle": (400, False), "operator": (0, True),
        "operator, 400 idle": (400, True)}  # fmt: skip


class Attack:
    """Points of a planted QP that may be mistaken for its solution."""

    def __init__(self, planted, rng, way="as it is", *, is_unique=True):
        self.qp, self.s, self.value = planted.qp, planted.solution, planted.value
        self.rng = rng
        self.prove = proves(reference_solution)
        self.is_unique = is_unique
        self.idle, is_operator = WAYS[way]
        self.stated = with_idle(self.qp, rng, self.idle) if self.idle else self.qp
        if is_operator:
            self.stated = replace(self.stated, P=Products(self.stated.P))

    def verified(self, s):
        s = replace(
            s, x=np.pad(s.x, (0, self.idle)), z_box=np.pad(s.z_box, (0, self.idle))
        )
        residuals = kkt_residuals(self.stated, s)
        error = decided(self.stated, s, residuals, TOL, self.prove)
        found = verdict(Status.SOLVED, residuals, TOL, error=error)
        return found is Verdict.VERIFIED

    def objective(self, x):
        x = x.astype(np.longdouble)
        return float(x @ (self.qp.P @ x) / 2 + self.qp.q @ x)

    def error(self, s):
        """Return |f − f*|/|f*|, or the error relative to the terms of f if f* is zero.

        f* counts as zero below 1e-10 of its terms, since rounding of x changes f by
        1e-6 of this value. The terms of qᵀx are its products, which may cancel.
        """
        x = self.s.x
        terms = max(abs(x @ (self.qp.P @ x)), abs(self.qp.q) @ abs(x)) or 1.0
        size = abs(self.value) if abs(self.value) > 1e-10 * terms else terms
        return abs(self.objective(s.x) - self.value) / size

    def violation(self, x, at):
        """Return the largest violation of a row or bound, relative to its terms at
        `at`.

        If other solutions are longer, rounding at such a solution does not count.
        """
        qp, worst = self.qp, 0.0
        box = np.eye(x.size)
        for M, off, b in (
            (qp.A, abs(qp.A @ x - qp.b), qp.b),
            (qp.G, qp.G @ x - qp.h, qp.h),
            (box, qp.lb - x, qp.lb),
            (box, x - qp.ub, qp.ub),
        ):
            size = abs(b) + abs(M) @ at
            told = np.isfinite(b) & (size > 0)
            if not self.is_unique:
                off = off - ROUNDING * (abs(b) + abs(M) @ abs(x))
            worst = max(worst, (off[told] / size[told]).max(initial=0.0))
        return worst

    def is_wrong(self, s):
        """Return True if the error exceeds 100·tol of the terms at the
        planted solution.
        """
        x, at = self.s.x, abs(self.s.x)
        terms = max(abs(x @ (self.qp.P @ x)), abs(self.qp.q) @ at)
        off = abs(self.objective(s.x) - self.value) / (terms or np.inf)
        return max(off, self.violation(s.x, at)) > 100 * TOL

    def rounded(self):
        """Return the solution with errors of at most two units in the last place."""

        def off(v):
            return v * (1 + 2.0**-52 * self.rng.integers(-2, 3, v.size))

        s, qp = self.s, self.qp
        return replace(
            s, x=np.clip(off(s.x), qp.lb, qp.ub), y=off(s.y), z=off(s.z),
            z_box=off(s.z_box),
        )  # fmt: skip

    def points(self, count):
        """Yield moves of all sizes, and further moves from points with
        small residuals.
        """
        best, worst = self.s, 0.0
        for k in range(count):
            start = best if k % 3 == 2 else self.s
            point = self.moved(start)
            yield point
            error = self.error(point)
            if error > worst and kkt_residuals(self.qp, point).worst <= 1e-7:
                best, worst = point, error

    def moved(self, s):
        rng, qp = self.rng, self.qp
        exponent = rng.uniform(0, 12) if rng.random() < 0.2 else rng.uniform(-12, 1)
        size = 10.0**exponent
        x, unit = s.x, self.unit(s.x)
        match rng.integers(0, 7):
            case 0:  # one variable
                x = x + size * unit * rng.standard_normal() * self.one(x.size)
            case 1:  # all variables
                x = x + size * unit * rng.standard_normal(x.size)
            case 2 | 3:  # along the rows that are active, also along free directions
                x = x + size * self.along_rows(x, unit)
            case 4:  # another vertex
                x = np.where(rng.random(x.size) < 0.5, 0, x)
            case 5:  # down the objective, through the rows
                slope = (qp.P @ x + qp.q) * unit
                x = x - size * unit * slope / (np.linalg.norm(slope) or 1)
            case _:  # only the multipliers
                return self.with_noise(s, size, 1 / 3)
        if rng.random() < 0.5:
            x = np.clip(x, qp.lb, qp.ub)
        s = replace(s, x=x)
        if rng.random() < 0.7:
            s = self.fitted(s)
        return self.with_noise(s, 10 ** rng.uniform(-12, -5), 0.15)

    def along_rows(self, x, unit):
        qp, rng = self.qp, self.rng
        tight = qp.h - qp.G @ x <= 1e-9 * (abs(qp.h) + abs(qp.G) @ abs(x))
        rows = np.vstack([qp.A, qp.G[tight & (rng.random(tight.size) < 0.7)]])
        free = (x != qp.lb) & (x != qp.ub)
        B = rows * np.where(free, unit, 0)
        B = B / np.maximum(np.linalg.norm(B, axis=1, keepdims=True), 1e-300)
        step = np.where(free, rng.standard_normal(x.size), 0)
        if B.size:
            step -= np.linalg.pinv(B, rcond=1e-11) @ (B @ step)
        return unit * step

    def fitted(self, s):
        """Return `s` with the multipliers of active constraints that best balance
        the gradient.
        """
        qp, x = self.qp, s.x
        g = qp.P @ x + qp.q
        tight = qp.h - qp.G @ x <= 1e-9 * (abs(qp.h) + abs(qp.G) @ abs(x))
        low, high = x <= qp.lb, x >= qp.ub
        B = np.vstack([qp.A, qp.G * tight[:, None], np.diag((low | high) * 1.0)]).T
        length = np.maximum(abs(B).max(axis=0), 1e-300)
        weight = 1 / np.maximum(np.maximum(abs(g), abs(B).max(axis=1)), 1e-300)
        scaled = B / length * weight[:, None]
        found = np.linalg.lstsq(scaled, -g * weight, rcond=None)[0] / length
        y, z, z_box = np.split(found, [qp.b.size, qp.b.size + qp.h.size])
        z_box = np.where(low & ~high, np.minimum(z_box, 0), z_box)
        z_box = np.where(high & ~low, np.maximum(z_box, 0), z_box)
        return replace(s, y=y, z=np.maximum(z, 0), z_box=z_box)

    def with_noise(self, s, size, probability):
        rng = self.rng
        changes = {
            name: v + size * self.unit(v) * rng.standard_normal(v.size)
            for name in ("y", "z", "z_box")
            if (v := getattr(s, name)).size and rng.random() < probability
        }
        return replace(s, **changes)

    def one(self, n):
        return np.arange(n) == self.rng.integers(n)

    @staticmethod
    def unit(v):
        return np.where(v != 0, abs(v), abs(v).max(initial=0.0) or 1.0)


def search(seed, tries, way, each=40):
    """Attack QPs with up to three traps; return wrong verdicts and a count.

    In the variant "as it is", a verified point must have three correct digits of f*,
    even if terms cancel. In all variants, its errors must be small relative to terms.
    """
    rng = np.random.default_rng(seed)
    wrong, refuted, verified = [], [], 0
    with np.errstate(all="ignore"):
        for _ in range(tries // each):
            kinds = frozenset(
                map(str, rng.choice([*KINDS], rng.integers(0, 4), replace=False))
            )
            number = int(rng.integers(2**30))
            is_unique = not kinds & {"duplicates", "free direction", "singular"}
            attack = Attack(hard(kinds, number), rng, way, is_unique=is_unique)
            for _ in range(3):
                s = attack.rounded()
                if attack.error(s) < 1e-9 and not attack.verified(s):
                    refuted.append((sorted(kinds), number))
            for s in attack.points(each - 3):
                if attack.verified(s):
                    verified += 1
                    is_off = way == "as it is" and attack.error(s) > 1e-3
                    if is_off or attack.is_wrong(s):
                        wrong.append((sorted(kinds), number, s.x))
    return wrong, refuted, verified


@pytest.mark.parametrize(
    "way",
    [
        pytest.param(w, marks=[pytest.mark.slow] * (w == "operator, 400 idle"))
        for w in WAYS
    ],
)
def test_a_short_search_finds_no_wrong_point_verified_and_no_right_one_refuted(way):
    wrong, refuted, verified = search(271828, 120, way)

    assert (wrong, refuted) == ([], [])
    assert verified > 5


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_a_search_of_a_hundred_thousand_points_finds_no_wrong_verdict(way):
    """One of 7500 right points is refuted, for a big-M problem (docs/verdicts.md)."""
    wrong, refuted, verified = search(314159, 100_000 // len(WAYS), way)

    assert wrong == []
    assert len({number for _, number in refuted}) <= 1
    assert all({"big-M", "cancelled"} <= set(kinds) for kinds, _ in refuted)
    assert verified > 10_000 // len(WAYS)


def idle_beside(*values, count=400):
    """Append `count` zeros to each list of values."""
    return [np.pad(np.array(v, dtype=float), (0, count)) for v in values]


@pytest.mark.parametrize("count", [0, 400])
@pytest.mark.parametrize(
    ("cost", "bend", "tol"),
    [(1e7, 1e-6, 1e-8), (1e3, 1e-6, 1e-4), (1e12, 1e-6, 1e-8), (1e5, 1e-3, 1e-6)],
)
def test_other_costs_do_not_hide_a_violated_row(cost, bend, tol, count):
    """min Cx₁ + x₂ + ½s‖x‖², x₂ = 1, x₁ ≥ 0 has x* = (0, 1)."""
    q, row, pulls, right = idle_beside(
        [cost, 1], [0, 1], [-cost, 0], [0, 1], count=count
    )
    lb = np.where(q == cost, 0, -INF)
    qp = qp_of([bend] * q.size, q, A=[row], b=[1], lb=lb)

    for y in (-1.0, 0.0, -2.0):
        assert judge(qp, at(0 * q, [y], z_box=pulls), tol) is Verdict.WRONG
    assert judge(qp, at(right, [-1 - bend], z_box=pulls), tol) is Verdict.VERIFIED
    nearly = at((1 + tol) * right, [-1 - bend], z_box=pulls)
    assert judge(qp, nearly, tol) is Verdict.VERIFIED


@pytest.mark.parametrize("count", [0, 400])
@pytest.mark.parametrize("tol", [1e-8, 1e-4])
def test_an_operator_without_diagonal_hides_no_force(tol, count):
    """min ½‖x‖² + 3e5x₁ + x₂, x₁ = 0 has x* = (0, −1)."""
    q, row, bends, right = idle_beside([3e5, 1], [1, 0], [1, 1], [0, -1], count=count)
    qp = replace(qp_of(bends, q, A=[row], b=[0]), P=Products(np.diag(bends)))

    assert judge(qp, at(0 * q, [-3e5]), tol) is Verdict.WRONG
    assert judge(qp, at(right, [-3e5]), tol) is Verdict.VERIFIED


@pytest.mark.parametrize("count", [0, 400])
def test_a_narrow_box_does_not_increase_the_scale_of_a_row(count):
    """x₁ has stiffness 1e18 and bounds 2e-9 apart; x₂ = 1 has stiffness 1."""
    bends, q, row, wrong = idle_beside(
        [1e18, 1], [-1e18, 0], [0, 1], [1, 0], count=count
    )
    near = 1e-9 * (q != 0)
    lb = np.where(q != 0, 1 - near, -INF)
    qp = qp_of(bends, q, A=[row], b=[1], lb=lb, ub=np.where(q != 0, 1 + near, INF))

    assert judge(qp, at(wrong, [0]), 1e-4) is Verdict.WRONG
    assert judge(qp, at(wrong + row, [-1]), TOL) is Verdict.VERIFIED


def judge_decided(qp, s, tol=TOL):
    """Return the verdict by residuals, or by the proven optimum if it decides."""
    residuals = kkt_residuals(qp, s)
    error = decided(qp, s, residuals, tol, proves(reference_solution))
    return verdict(Status.SOLVED, residuals, tol, error=error)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("count", [0, 400])
def test_a_remote_row_hides_no_violation(sign, count):
    """min ½x₁² − x₁, x₁ = x₂ ≤ ½, x₂ ≥ −1e12 has x* = (½, ½)."""
    bends, q, row, far, right, wrong, pulls = idle_beside(
        [1, 0], [-1, 0], [sign, -sign], [0, -1], [0.5, 0.5], [1, 0.5], [0, 0.5],
        count=count,
    )  # fmt: skip
    ub = np.where(np.arange(q.size) == 1, 0.5, INF)
    qp = qp_of(bends, q, A=[row], b=[0], G=[far], h=[1e12], ub=ub)

    assert judge(qp, at(wrong, [0], [0]), 1e-4) is Verdict.WRONG
    assert judge(qp, at(right, [0.5 * sign], [0], z_box=pulls)) is Verdict.VERIFIED


@pytest.mark.parametrize("off", [1e-9, -1e-9])
@pytest.mark.parametrize("rows", ["A", "-A", "G", "-G"])
def test_a_chain_of_idle_variables_is_as_long_as_its_first_row(rows, off):
    """min ½x₁² − x₁, x₁ − x₂ = 1, x₂ = … = x₈ has x* = (1, 0, …, 0), f* = −½."""
    sign, n, b = -1 if rows[0] == "-" else 1, 8, np.eye(7)[0]
    M = sign * (np.eye(n - 1, n) - np.eye(n - 1, n, 1))
    is_equal = rows[-1] == "A"
    stated = dict(A=M, b=sign * b) if is_equal else dict(G=M, h=sign * b)
    qp = qp_of(np.eye(n)[0], -np.eye(n)[0], **stated)
    none = np.zeros(n - 1)

    for j in range(1, n):
        x = np.eye(n)[0] + off * np.eye(n)[j]
        s = at(x, none) if is_equal else at(x, z=none)
        assert judge(qp, s) is Verdict.VERIFIED
        far = replace(s, x=s.x + 1e7 * off * np.eye(n)[j])
        if is_equal or (M[j - 1, j] * off > 0):  # beyond the row
            assert judge(qp, far) is Verdict.WRONG


def test_a_row_of_large_variables_is_satisfied_to_their_accuracy():
    """x* = (512, −512) is 256 times the length over which the energy changes by E."""
    soft = 2.0**-18  # curvature along (1, −1), in which x is long
    P = np.array([[1 + soft, 1 - soft], [1 - soft, 1 + soft]])
    x, off = np.array([512.0, -512.0]), 2.0**-17
    qp = qp_of(P, -(P @ x), A=[[1, 1]], b=[0])  # y* = 0
    s = at(x + off, [-2 * off])

    exact, near = ([Fraction(v) for v in point] for point in (x, s.x))
    error = objective(qp, near) - objective(qp, exact)
    assert 0 < error <= Fraction(TOL) * 2  # relative to the terms, 4
    assert sum(near) <= Fraction(2 * TOL) * 1024  # relative to its terms
    assert sum(near) > Fraction(10 * TOL) * 4 * 10  # relative to ten lengths
    assert judge(qp, s) is Verdict.VERIFIED
    assert judge(qp, at(x + 100 * off, [-200 * off])) is not Verdict.VERIFIED


def objective(qp, x):
    """Evaluate the objective in fractions."""
    P, q = [[Fraction(v) for v in row] for row in qp.P], map(Fraction, qp.q)
    bend = sum(a * P[i][j] * b for i, a in enumerate(x) for j, b in enumerate(x))
    return bend / 2 + sum(c * a for c, a in zip(q, x, strict=True))


@pytest.mark.parametrize(
    "cost", [1e12, *(pytest.param(c, marks=pytest.mark.slow) for c in (1e6, 1e9))]
)
def test_costs_on_bounds_hide_no_error_of_a_vanishing_objective(cost):
    """x* = (0, 0, 0, 1, 1), f* = 0 with terms 1 and ½; the costs have energies C²."""
    qp = qp_of(
        [1, 1, 1, 1, 0], [cost] * 3 + [-1, 0.5],
        lb=[0, 0, 0, -INF, 1], ub=[INF] * 4 + [1],
    )  # fmt: skip
    pulls = [-cost] * 3 + [0, -0.5]

    def judged_at(x, tol):
        return judge_decided(qp, at([0, 0, 0, x, 1], z_box=pulls), tol)

    assert judged_at(1, TOL) is Verdict.VERIFIED
    assert judged_at(1 - 1e-9, TOL) is Verdict.VERIFIED
    for tol in (TOL, 1e-4):
        assert judged_at(0, tol) is Verdict.WRONG  # ½ for 0
        assert judged_at(1 - 2 * np.sqrt(100 * tol), tol) is not Verdict.VERIFIED


def test_a_tiny_cost_is_not_the_scale_of_a_vanishing_solution():
    """min ½‖x‖² + x₁ + x₂ + 1e-9·x₃, x ≥ 0 has x* = 0."""
    qp = qp_of([1] * 3, [1, 1, 1e-9], lb=0)
    pulls = [-1, -1, -1e-9]

    assert judge_decided(qp, at([1e-11] * 3, z_box=pulls)) is Verdict.VERIFIED
    assert judge_decided(qp, at([1e-2] * 3, z_box=pulls)) is Verdict.WRONG


@pytest.mark.parametrize(
    ("n", "with_row"), [(1, False), (3, False), (403, False), (1, True), (3, True)]
)
def test_a_point_within_rounding_of_zero_is_verified_for_data_of_order_one(n, with_row):
    """min Σxⱼ, x ≥ 0, possibly with Σxⱼ ≥ 0, has x* = 0; 1e-11 is not an error."""
    G, h = ([-np.ones(n)], [0]) if with_row else (None, ())
    qp = qp_of([0] * n, [1] * n, G=G, h=h, lb=0)
    s = at([1e-11] * n, z=[0.5] * with_row, z_box=[-0.5 if with_row else -1.0] * n)

    for point, expected in (
        (s, Verdict.VERIFIED), (replace(s, x=s.x + 1e-2), Verdict.WRONG),
    ):  # fmt: skip
        assert judge_decided(qp, point) is expected
