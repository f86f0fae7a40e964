"""Bounds of optimal values contain the exact optimum, whatever point they are given."""

from fractions import Fraction

import numpy as np
import pytest

from mortarbench import QP, Discs
from mortarbench.dataset.optimum import (
    UnprovenError,
    least_curvature,
    optimum_interval,
    tightened,
)
from mortarbench.solvers.reference.solve import reference_solution


def box_qp():
    """Return min ½x₁² + x₂² − x₁ − x₂ on x ≤ ¼ with f* = −7/32 − 3/16 = −13/32."""
    return QP.from_arrays(np.diag([1.0, 2.0]), [-1.0, -1.0], ub=0.25)


def plane_qp():
    """Return min ½‖x‖² with x₁ + x₂ = 1/3, x₁ ≤ 1/10: f* = ½(1/100 + 49/900)."""
    return QP.from_arrays(np.eye(2), [0.0, 0.0], [[1, 0]], [0.1], [[1, 1]], [1 / 3])


def exact_plane_optimum():
    one, two = Fraction(0.1), Fraction(1 / 3) - Fraction(0.1)
    return (one**2 + two**2) / 2


def test_the_interval_at_the_solution_is_narrow_and_contains_the_exact_optimum():
    low, high = optimum_interval(box_qp(), np.full(2, 0.25), np.zeros(0), np.zeros(0))
    assert low <= -13 / 32 <= high
    assert high - low < 1e-14

    x = reference_solution(tightened(plane_qp())).x
    low, high = optimum_interval(plane_qp(), x, np.array([-7 / 30]), np.array([4 / 30]))
    assert Fraction(low) <= exact_plane_optimum() <= Fraction(high)
    assert high - low < 1e-12


@pytest.mark.parametrize("size", [1e-9, 1e-3, 1.0])
def test_wrong_points_and_multipliers_widen_the_interval_but_do_not_exclude(size):
    rng = np.random.default_rng(5)
    for _ in range(20):
        dx, dy, dz = size * rng.standard_normal(3)
        x = np.array([0.05 - abs(dx), 1 / 3 - 0.05 + abs(dx)])
        y, z = np.array([-7 / 30 + dy]), np.array([4 / 30 + dz])
        low, high = optimum_interval(plane_qp(), x, y, z)
        assert Fraction(low) <= exact_plane_optimum() <= Fraction(high)


def test_discs_and_singular_curvature_are_bounded():
    # min −x₁ over the disc of radius 2: f* = −2, and P = 0 on the third variable
    disc = QP.from_arrays(
        np.diag([1e-8, 1e-8, 0.0]), [-1.0, 0.0, 0.0], lb=[-np.inf, -np.inf, 0.0],
        sets=[Discs([[0, 1]], [2.0])],
    )  # fmt: skip
    x = np.array([2 - 1e-13, 0.0, 0.0])
    low, high = optimum_interval(disc, x, np.zeros(0), np.zeros(0))
    assert low <= -2 + 2e-8 <= high
    assert high - low < 1e-12


def test_a_point_that_violates_the_rows_proves_little_or_nothing():
    multipliers = np.array([-7 / 30]), np.array([4 / 30])
    low, high = optimum_interval(plane_qp(), np.array([0.0, 0.32]), *multipliers)
    assert Fraction(low) <= exact_plane_optimum() <= Fraction(high)
    with pytest.raises(UnprovenError, match="violates"):
        optimum_interval(plane_qp(), np.array([0.2, 1 / 3 - 0.2]), *multipliers)


@pytest.mark.parametrize("n", [3, 60])
def test_the_least_curvature_is_below_the_least_eigenvalue(n):
    rng = np.random.default_rng(n)
    orthogonal, _ = np.linalg.qr(rng.standard_normal((n, n)))
    for least in (0.5, 1e-3, 1e-7):
        values = np.linspace(least, 1, n)
        P = orthogonal * values @ orthogonal.T
        scaled = P / np.sqrt(np.outer(P.diagonal(), P.diagonal()))
        bound = least_curvature((P + P.T) / 2)
        # diag(4ᵉ) differs from the diagonal by a factor of up to 4
        assert 0 < bound <= 4 * np.linalg.eigvalsh(scaled)[0]
    assert least_curvature(orthogonal * np.linspace(-1e-7, 1, n) @ orthogonal.T) == 0


def test_an_indefinite_problem_is_refused():
    P = np.array([[1.0, 1.0], [1.0, 1 - 1e-6]])
    qp = QP(P=P, q=np.zeros(2), lb=-np.ones(2), ub=np.ones(2))
    with pytest.raises(UnprovenError, match="semidefinite"):
        optimum_interval(qp, np.zeros(2), np.zeros(0), np.zeros(0))


def test_dependent_equations_are_refused():
    rows = [[1.0, 1.0], [2.0, 2.0]]
    qp = QP.from_arrays(np.eye(2), [0.0, 0.0], A=rows, b=[1.0, 2.0])
    with pytest.raises(UnprovenError, match="dependent"):
        optimum_interval(qp, np.full(2, 0.5), np.zeros(2), np.zeros(0))
