"""Verdicts on right and wrong points of small QPs whose solutions are known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import diags_array, eye_array, hstack
from scipy.sparse.linalg import aslinearoperator

from mortarbench.harness import QP, Verdict
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.harness.verify.multipliers import with_multipliers
from tests.support.small_qps import at, judge

INF = np.inf
qp_of = QP.from_arrays


def diagonal(P, q, **rest):
    return qp_of(diags_array(np.array(P, dtype=float)), q, **rest)


# comments state the solution and its objective
FAR = diagonal([1, 1], [-1, -1], A=[[1, 1]], b=[1], ub=1e7)  # (½, ½), −¾
FLAT = diagonal([1e-9] * 5, [1, 2, 3, 4, 5], A=[[1] * 5], b=[1], lb=0)  # e₁, 1
HIDDEN = diagonal([1, 1], [0, 0], G=[[0, 1e-12]], h=[1], lb=[1, -INF])  # (1, 0), ½
AS_ROW = diagonal([1, 1], [0, 0], G=[[-1, 0], [0, 1e-12]], h=[-1, 1])  # (1, 0), ½
COSTLY = diagonal([1, 1], [1e9, -1], lb=[0, -INF], ub=[1, INF])  # (0, 1), −½
LONG = diagonal([1, 0, 0], [0, 0, 0], A=[[1, 1, -1], [0, 1, -1]], b=[1, 0])  # x₁ = 1, ½
UNITS = diagonal([1, 1e16], [-1, 0], lb=[-INF, 1e-8])  # (1, 1e-8), 0
#: (½, ½, ½), 1.5; within its bounds, each variable could gain 1e12
WIDE = qp_of(
    np.zeros((3, 3)), [1] * 3, G=[[-1, -1, 0], [0, -1, -1], [-1, 0, -1]], h=[-1] * 3,
    lb=-1e12, ub=1e12,
)  # fmt: skip
#: (−3, 3.5), −1.2e10; the multiplier of the row is negligible
BESIDE = diagonal([0, 0], [4e9, 1], A=[[0, 1]], b=[3.5], lb=[-3, -INF])
TINY_COST = diagonal([1] * 3, [1, 1, 1e-9], lb=0)  # 0, 0
ALL = [-1, -1, -1e-9]
#: (½, ½), −¼; a remote bound of x₂, stated as a row
REMOTE = diagonal(
    [1, 0], [-1, 0], A=[[1, -1]], b=[0], G=[[0, -1]], h=[1e12], ub=[INF, 0.5]
)


# comments state the objective at the point
@pytest.mark.parametrize("tol", [1e-8, 1e-4])
@pytest.mark.parametrize(
    ("qp", "s"),
    [
        (FAR, at([1, 1], [0])),  # −1; the row is violated by 1
        (FAR, at([0, 0], [1])),  # 0, and stationary
        (FLAT, at([0] * 5, [0])),  # 0
        (FLAT, at([0] * 5, [-1], z_box=[0, -1, -2, -3, -4])),
        (FLAT, at([0, 0, 0, 0, 1], [-1], z_box=[0, -1, -2, -3, -4])),  # 5
        (FLAT, at([0, 0, 0, 0, 1], [-5], z_box=[4, 3, 2, 1, 0])),
        (FLAT, at([0, 0, 0, 0, 1], [-3], z_box=[0, 0, 0, 0, 0])),
        (HIDDEN, at([0, 0], z=[0])),  # 0
        (HIDDEN, at([0, 1e12], z=[0])),
        (AS_ROW, at([0, 0], z=[0, 0])),
        (AS_ROW, at([0, 0], z=[1, 0])),
        (LONG, at([0, 0, 0], [0, 0])),  # 0
        (UNITS, at([1, 0])),  # below its bound by the entire bound
        (WIDE, at([2] * 3, z=[0.5] * 3)),  # 6
        (BESIDE, at([-3, 5.5], [-1], z_box=[-4e9, 0])),
        (REMOTE, at([1, 0.5], [0], [0])),
        (TINY_COST, at([0.1] * 3, z_box=ALL)),
        (diagonal([1, 1], [0, 0], ub=1), at([0.1, 0.1])),
    ],
)
def test_a_wrong_point_is_refuted(qp, s, tol):
    assert judge(qp, s, tol) is Verdict.WRONG


TINY = 6e-13  #: ½x² + ½x² = 4e-25


@pytest.mark.parametrize(
    ("qp", "s"),
    [
        (FAR, at([0.5, 0.5], [0.5])),
        (FLAT, at([1, 0, 0, 0, 0], [-1 - 1e-9], z_box=[0, -1, -2, -3, -4])),
        (COSTLY, at([0, 1], z_box=[-1e9, 0])),
        (LONG, at([1, 1e12, 1e12], [-1, 1])),
        (LONG, at([1, 0, 0], [-1, 1])),
        (WIDE, at([0.5] * 3, z=[0.5] * 3)),
        (BESIDE, at([-3, 3.5], [-1], z_box=[-4e9, 0])),
        (REMOTE, at([0.5, 0.5], [0.5], [0], [0, 0.5])),
        (TINY_COST, at([1e-11] * 3, z_box=ALL)),
        (diagonal([1, 1], [0, 0], ub=1), at([TINY, TINY])),
        (diagonal([1, 1], [0, 0], lb=0), at([TINY, TINY])),
        (diagonal([1, 1], [0, 0]), at([TINY, TINY])),
        (diagonal([1, 1], [0, 0], A=[[1, -1]], b=[0]), at([TINY, TINY], [0])),
        (diagonal([1, 1], [0, 0], G=[[1, 1]], h=[5]), at([TINY, TINY], z=[0])),
        (diagonal([1, 1], [1e-17, -3e-17], lb=0, ub=3), at([TINY, TINY])),
        # a gradient of 1e-9 with a noise of 1e-10, together with a gradient of 1
        (diagonal([1, 1], [-1, -1e-9]), at([1, 9e-10])),
        # x₂ is at its bound, whose multiplier of 1e-9 is missing
        (diagonal([1, 0], [-1, 1e-9], lb=[-INF, 75]), at([1, 75])),
        (diagonal([1, 0], [-1, -1e-9], ub=[INF, -75]), at([1, -75])),
        (diagonal([1, 0], [-1e-6, 1e-15], lb=[-INF, 0]), at([1e-6, 0])),
        # a fixed variable of cost −½ cancels the objective
        (diagonal([1, 0], [0, -0.5], A=[[1, 0]], b=[1], lb=[-INF, 1], ub=[INF, 1]),
         at([1 + 1e-9, 1], [-1 - 1e-9], z_box=[0, 0.5])),
    ],
)  # fmt: skip
def test_a_right_point_is_verified(qp, s):
    assert judge(qp, s) is Verdict.VERIFIED


@pytest.mark.parametrize(
    ("qp", "s", "tol"),
    [
        # costs of 1e9 beside 1, and a point with f = 0
        (COSTLY, at([0, 0], z_box=[-1e9, 0]), 1e-8),
        # x₂ = x₃ drift to 1e12 without cost; x₁ = 0 instead of 1
        (LONG, at([0, 1e12, 1e12], [0, 0]), 1e-8),
        # stiffness 1e18 beside 1; x₂ = 0 instead of 1
        (diagonal([1e18, 1], [-1e18, 0], A=[[0, 1]], b=[1]), at([1, 0], [0]), 1e-4),
        # the rows x₂ ≤ 0 and x₂ ≥ −2⁻³⁴x₁ are nearly parallel; f = −⅛ instead of 0
        (diagonal([1, 1], [0.5, 0], G=[[0, 1], [-(2.0**-34), -1]], h=[0, 0]),
         at([-0.5, 2.0**-36], z=[0, 0]), 1e-8),
        # curvature 1e-15 along (1, −1), in which the objective still falls by ½
        (qp_of([[1 + 2.0**-50, 1 - 2.0**-50], [1 - 2.0**-50, 1 + 2.0**-50]],
               [-1 - 2.0**-25, -1 + 2.0**-25]), at([0.5, 0.5]), 1e-8),
    ],
    ids=["costs", "drift", "stiffness", "parallel", "weak"],
)  # fmt: skip
def test_stated_limits_of_the_rule(qp, s, tol):
    """These wrong points are verified, as docs/verdicts.md states."""
    assert judge(qp, s, tol) is Verdict.VERIFIED


def idle_beside(*values, count):
    """Append `count` zeros to each list of values."""
    return [np.pad(np.array(v, dtype=float), (0, count)) for v in values]


@pytest.mark.parametrize("count", [0, 40])
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
    qp = diagonal([bend] * q.size, q, A=[row], b=[1], lb=lb)

    for y in (-1.0, 0.0, -2.0):
        assert judge(qp, at(0 * q, [y], z_box=pulls), tol) is Verdict.WRONG
    for x in (right, (1 + tol) * right):
        s = at(x, [-1 - bend], z_box=pulls)
        assert judge(qp, s, tol) is Verdict.VERIFIED


@pytest.mark.parametrize("off", [1e-9, -1e-9])
@pytest.mark.parametrize("rows", ["A", "-A", "G", "-G"])
def test_a_chain_of_idle_variables_is_as_long_as_its_first_row(rows, off):
    """min ½x₁² − x₁, x₁ − x₂ = 1, x₂ = … = x₈ has x* = (1, 0, …, 0), f* = −½."""
    sign, n, b = -1 if rows[0] == "-" else 1, 8, np.eye(7)[0]
    M = sign * (np.eye(n - 1, n) - np.eye(n - 1, n, 1))
    is_equal = rows[-1] == "A"
    stated = dict(A=M, b=sign * b) if is_equal else dict(G=M, h=sign * b)
    qp, none = diagonal(np.eye(n)[0], -np.eye(n)[0], **stated), np.zeros(n - 1)

    for j in range(1, n):
        x = np.eye(n)[0] + off * np.eye(n)[j]
        s = at(x, none) if is_equal else at(x, z=none)
        assert judge(qp, s) is Verdict.VERIFIED
        far = replace(s, x=s.x + 1e7 * off * np.eye(n)[j])
        if is_equal or (M[j - 1, j] * off > 0):  # beyond the row
            assert judge(qp, far) is Verdict.WRONG


@pytest.mark.parametrize("with_row", [False, True])
@pytest.mark.parametrize("n", [1, 3, 40])
def test_a_solution_at_zero_has_the_length_one(n, with_row):
    """min Σxⱼ, x ≥ 0, possibly with Σxⱼ ≥ 0, has x* = 0."""
    row = dict(G=[-np.ones(n)], h=[0]) if with_row else {}
    qp = diagonal([0] * n, [1] * n, lb=0, **row)
    s = at([1e-11] * n, z=[0.5] * with_row, z_box=[-0.5 if with_row else -1.0] * n)

    assert judge(qp, s) is Verdict.VERIFIED
    assert judge(qp, replace(s, x=s.x + 1e-2)) is Verdict.WRONG


def test_a_row_of_large_variables_is_satisfied_to_their_accuracy():
    """x* = (512, −512), and the terms of the row x₁ + x₂ = 0 are 1024."""
    soft, off = 2.0**-18, 2.0**-17
    P = np.array([[1 + soft, 1 - soft], [1 - soft, 1 + soft]])
    x = np.array([512.0, -512.0])
    qp = qp_of(P, -(P @ x), A=[[1, 1]], b=[0])  # y* = 0

    assert judge(qp, at(x + off, [-2 * off])) is Verdict.VERIFIED
    assert judge(qp, at(x + 100 * off, [-200 * off])) is Verdict.INACCURATE


def test_multipliers_that_cancel_do_not_hide_a_gap():
    """min ½x², x = 1 (twice): the multipliers −2³⁹ − 1 − δ and 2³⁹ leave a gap of δ."""
    gap = 2.0**-10
    qp = qp_of([[1]], [0], A=[[1], [1]], b=[1, 1])

    r = kkt_residuals(qp, at([1], [-(2.0**39) - 1 - gap, 2.0**39]))
    assert (r.dual, r.gap) == (gap, gap)


# --- reports of users on earlier rules ------------------------------------------------


@pytest.mark.parametrize("count", [1, 40])
@pytest.mark.parametrize("error", [0, 1e-31, 1e-15, 1e-9])
@pytest.mark.parametrize("way", ["row", "bounds", "inequality", "zero"])
def test_rounding_beside_a_variable_at_zero_is_no_error(way, error, count):
    """min ½Σ(xⱼ − 1)² + ½x₁²: x₁ = 0; the constraint of the last variable is active."""
    P, q, row, x = idle_beside([1], [0], [0], [error], count=count)
    P[1:], q[1:], x[1:] = 1, -1, 1
    P, q, row, x = (np.append(v, end) for v, end in ((P, 0), (q, 0), (row, 1), (x, 6)))
    far = np.where(row > 0, 6, INF)
    stated = {
        "row": dict(A=[row], b=[6]),
        "bounds": dict(lb=np.where(row > 0, 6, -INF), ub=far),
        "inequality": dict(G=[-row], h=[-6]),
        "zero": dict(A=[row], b=[0]),
    }[way]
    x[-1] = error if way == "zero" else 6
    qp = diagonal(P, q, **stated)
    none = dict(y=0 * qp.b, z=0 * qp.h)

    assert judge(qp, at(x, **none)) is Verdict.VERIFIED
    x[-1 if way == "zero" else 0] = 1e-4
    assert judge(qp, at(x, **none)) is not Verdict.VERIFIED


@pytest.mark.parametrize("count", [0, 40])
@pytest.mark.parametrize(
    ("w", "expected"),
    [(1, True), (1 + 1e-9, True), (1.000001, False), (3, False), (100, False)],
)
def test_rows_without_right_hand_side_are_judged_by_their_terms(w, expected, count):
    """min ½(u − 1)² + 1e-4v, v = 1e-3w, w = t, t ≥ 1 has u = w = t = 1."""
    ones = [1.0] * (count + 1)
    A = np.zeros((2, count + 4))
    A[0, -3:-1], A[1, -2:] = [1, -1e-3], [1, -1]
    lb = np.full(count + 4, -INF)
    lb[-1] = 1
    qp = diagonal(
        [*ones, 0, 0, 0], [*(-v for v in ones), 1e-4, 0, 0], A=A, b=[0, 0], lb=lb
    )
    x, z_box = [*ones, 1e-3 * w, w, 1], [*(0 * v for v in ones), 0, 0, -1e-7]

    given = judge(qp, at(x, [-1e-4, -1e-7], z_box=z_box))
    fitted = judge(qp, with_multipliers(qp, np.array(x)))
    assert [v is Verdict.VERIFIED for v in (given, fitted)] == [expected] * 2


@pytest.mark.parametrize("count", [2, 40])
@pytest.mark.parametrize("error", [0, 1e-11, 1e-9, 1e-8])
def test_an_error_of_an_idle_multiplier_is_relative_to_the_largest_force(error, count):
    """The column of w in v = 1e-6w, w + p = 2, −w + r = −1 contains 1e-6 and 1."""
    n, (v, w, p, r) = count + 4, range(count, count + 4)
    A, lb = np.zeros((3, n)), np.full(n, -INF)
    A[0, v], A[0, w], A[1, w], A[1, p], A[2, w], A[2, r] = 1, -1e-6, 1, 1, -1, 1
    lb[[v, p, r]] = 0
    ones = np.ones(count)
    qp = diagonal(
        [*ones, 0, 0, 0, 0], [*-ones, 1e-6, 0, 1, 1], A=A, b=[0, 2, -1], lb=lb
    )
    y = [-1e-6, -1, -1 + 1e-12 + error]
    z_box = np.zeros(n)
    z_box[r] = -(1 + y[2])

    assert judge(qp, at([*ones, 1e-6, 1, 1, 0], y, z_box=z_box)) is Verdict.VERIFIED


@pytest.mark.parametrize(
    ("count", "error", "expected"),
    [(3, 0, True), (3, 1e-9, True), (3, 1e-7, False), (250, 1e-11, True)],
)
def test_a_target_that_is_reached_has_the_natural_energy(count, error, expected):
    """min ½‖s‖², s = aF − g, 0 ≤ F ≤ 30 has s = 0, F = g/a and f* = 0."""
    a = np.random.default_rng(1).uniform(0.01, 1, count)
    s, zero = np.full(count, error), np.zeros(count)
    qp = diagonal(
        [*np.ones(count), *zero],
        [*zero, *zero],
        A=hstack([eye_array(count), -diags_array(a)]),
        b=zero - 0.2,
        lb=[*(zero - INF), *zero],
        ub=[*(zero + INF), *(zero + 30)],
    )
    x = np.concatenate([s, (s + 0.2) / a])

    assert (judge(qp, at(x, -s)) is Verdict.VERIFIED) == expected


@pytest.mark.parametrize(("n", "m"), [(3, 2), (30, 10)])
def test_every_feasible_point_solves_a_problem_without_cost(n, m):
    rng = np.random.default_rng(0)
    A, x = rng.standard_normal((m, n)), rng.uniform(0.2, 0.8, n)
    qp = qp_of(np.zeros((n, n)), np.zeros(n), A=A, b=A @ x, lb=0, ub=1)

    assert judge(qp, at(x, np.zeros(m))) is Verdict.VERIFIED
    assert judge(qp, at(x + 1e-3, np.zeros(m))) is not Verdict.VERIFIED


def test_an_operator_without_diagonal_hides_no_force():
    """min ½‖x‖² + 3e3x₁ + x₂, x₁ = 0 has x* = (0, −1)."""
    qp = diagonal([1, 1], [3e3, 1], A=[[1, 0]], b=[0])
    qp = replace(qp, P=aslinearoperator(np.eye(2)))

    assert judge(qp, at([0, 0], [-3e3])) is not Verdict.VERIFIED
    assert judge(qp, at([0, -1], [-3e3])) is Verdict.VERIFIED
