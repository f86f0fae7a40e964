"""The stopping test of the in-house solvers, on points whose errors are known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.linalg import aslinearoperator

from mortarbench.harness import QP, Cones, Discs, Solution, Status
from mortarbench.solvers.common.stopping import relative_residual


def at(x, y=(), z=(), z_box=None):
    x, y, z = (np.array(v, dtype=float) for v in (x, y, z))
    z_box = 0 * x if z_box is None else np.array(z_box, dtype=float)
    return Solution(status=Status.SOLVED, x=x, y=y, z=z, z_box=z_box)


def residual(qp, s):
    return relative_residual(qp, s, 1e-6)


def changed(s, **vectors):
    return replace(s, **{k: np.array(v, dtype=float) for k, v in vectors.items()})


def block():
    """½|x|² − 4x₁ − 2x₂ with x₁ + x₂ = 4, x₁ − x₃ ≤ 1, x₃ ≤ 1, solved by (2, 2, 1).

    Stationarity is x₁ − 4 + y + z = 0, x₂ − 2 + y = 0, x₃ − z + z_box = 0. The scales
    are ‖q‖∞ = 4 for forces and |qᵀx| = 12 for the gap.
    """
    qp = QP.from_arrays(
        np.eye(3), [-4, -2, 0], A=[[1, 1, 0]], b=[4], G=[[1, 0, -1]], h=[1],
        ub=[np.inf, np.inf, 1],
    )  # fmt: skip
    return qp, at([2, 2, 1], [0], [2], [0, 0, 1])


def test_a_solution_has_no_residual():
    assert residual(*block()) == 0


@pytest.mark.parametrize(
    ("vectors", "expected"),
    [
        ({"y": [1e-3]}, 4e-3 / 12),  # the gap changes by bᵀy, r by y
        ({"z": [2 + 4e-3]}, 4e-3 / 4),
        ({"z_box": [0, 0, 1 + 2e-2]}, 2e-2 / 4),
        ({"z_box": [0, 0, -1]}, 1 / 4),  # multipliers with a wrong sign count as zero
        ({"z": [-2]}, 2 / 4),
        ({"z_box": [1e-3, 0, 1]}, 0),  # x₁ has no bound
    ],
)
def test_errors_of_multipliers_are_relative_to_forces_and_energy(vectors, expected):
    qp, s = block()
    found = residual(qp, changed(s, **vectors))
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-15)


def free(n, **constraints):
    """P = 0 and q = 0: only constraints can be violated."""
    return QP.from_arrays(np.zeros((n, n)), np.zeros(n), **constraints)


@pytest.mark.parametrize(
    ("qp", "x", "expected"),
    [
        (free(2, A=[[1, 1]], b=[4]), [2, 2.008], 0.008 / (4 + 4.008)),
        (free(2, G=[[3, 0]], h=[-1]), [1, 2], 4 / (1 + 3)),
        (free(2, G=[[3, 0]], h=[4]), [1, 2], 0),
        (free(2, lb=[1, 0]), [0.5, 4], 0.5 / (1 + 0.5)),
        (free(2, ub=[1, 0]), [-4, 1], 1),
        (free(2, ub=[1, 0]), [-4, 0.1], 0.1 / 0.4),  # relative to a tenth of ‖x‖∞
        (free(2, A=[[1, 0]], b=[1]), [2, 1e6], 1 / (1 + 1e3)),
        (free(2, sets=[Discs([[0, 1]], [1])]), [0, 2], 1 / (1 + 2)),
        (free(2, sets=[Cones([[0, 1]], [0.5])]), [1, 2], 1.5 / (0.5 + 2)),
        (free(1, A=[[0]], b=[1]), [0], 1),
        # the distant limit of one row is not a scale of another
        (free(2, G=np.eye(2), h=[1e20, 1]), [1, 1.01], 0.01 / 2.01),
    ],
    ids=["equality", "inequality", "slack", "lower", "upper", "zero bound", "floor",
         "disc", "cone", "zero row", "distant row"],
)  # fmt: skip
def test_a_violation_is_relative_to_its_row(qp, x, expected):
    s = at(x, 0 * qp.b, 0 * qp.h)
    assert residual(qp, s) == pytest.approx(expected, rel=1e-9, abs=1e-15)


@pytest.mark.parametrize("store", [np.asarray, csr_array])
def test_units_do_not_matter(store):
    """Units of rows, variables and objective; powers of two cause no rounding."""
    rng = np.random.default_rng(5)
    B = rng.standard_normal((4, 4))
    P, q, A, G = B @ B.T, B[0], B[1:2], B[2:3]
    s = at(B[3], [0.3], [0.2], [0, -1, 0.1, 0])
    qp = QP.from_arrays(store(P), q, A=A, b=[2], G=G, h=[-1], lb=-3, ub=3)
    D, e, f, c = np.array([4, 0.5, 2**8, 2**-7]), 2**11, 2**-30, 2**15
    other = QP.from_arrays(
        store(c * P * D[:, None] * D), c * q * D, A=e * A * D, b=[2 * e],
        G=f * G * D, h=[-f], lb=-3 / D, ub=3 / D,
    )  # fmt: skip
    same = at(s.x / D, c * s.y / e, c * s.z / f, c * s.z_box * D)
    assert residual(other, same) == pytest.approx(residual(qp, s))


def test_forces_that_vanish_are_relative_to_their_rounding_errors():
    """q = 0: the solution 0, and points of the kernel of P, computed with rounding."""
    rng = np.random.default_rng(6)
    B = rng.standard_normal((20, 8))
    x = np.linalg.svd(B.T)[2][-1]
    qp = QP.from_arrays(B @ B.T, np.zeros(20))
    assert residual(qp, at(0 * x)) == 0
    assert (qp.P @ x).any()
    assert residual(qp, at(x)) <= 1e-9
    assert residual(qp, at(x + 1e-9 * B[:, 0])) > 0.1


def test_without_an_objective_only_rows_have_a_scale():
    """P = 0 and q = 0: every feasible point is a solution, with multipliers of zero."""
    qp = free(2, A=[[1, 1]], b=[4])
    assert residual(qp, at([1, 3], [0])) == 0
    assert residual(qp, at([1, 3], [3e-9])) == pytest.approx(4e-9)  # bᵀy/max xⱼ


def test_energy_that_vanishes_beside_other_variables():
    """½s² with s − x/2 = −3 and x ≥ 0: s = 0, x = 6; s is found up to rounding."""
    qp = QP.from_arrays(np.diag([1, 0]), [0, 0], A=[[1, -0.5]], b=[-3])
    assert residual(qp, at([1e-22, 6], [-1e-22])) <= 1e-9
    assert residual(qp, at([1e-3, 6.002], [0])) > 0.1


@pytest.mark.parametrize(("size", "expected"), [(1e-13, 2e-6 / 3), (1e-11, 2e-4 / 3)])
def test_a_solution_of_zero_is_reached_up_to_the_error_of_admissible_forces(
    size, expected
):
    """min ½|x|² − x₁ with 2x₁ + x₂ = 0, x ≥ 0: forces of 1 to 1e-6 move x by 1e-6.

    The row of a point (size, 0) is violated by 2·size, relative to 0.1·3·1e-6.
    """
    qp = QP.from_arrays(np.eye(2), [-1, 0], A=[[2, 1]], b=[0], lb=0)
    assert residual(qp, at([0, 0], [0.5], z_box=[0, -0.5])) == 0
    s = at([size, 0], [0.5], z_box=[0, -0.5])
    assert residual(qp, s) == pytest.approx(expected, rel=1e-6)


def test_rounding_of_a_linear_program_has_no_curvature():
    """min 1e-9 x with x ≥ 1e9: r is 10 % of q, whatever the unit of x."""
    qp = QP.from_arrays([[0]], [1e-9], lb=1e9)
    assert residual(qp, at([1e9], z_box=[-1e-9])) == 0
    short = at([1e9], z_box=[-0.9e-9])
    assert residual(qp, short) == pytest.approx(0.1, rel=1e-5)


def test_an_operator_without_a_diagonal_has_one_unit_for_all_variables():
    P = np.diag([1.0, 100.0])
    qp, s = QP.from_arrays(P, [-1, -100]), at([1, 1 + 1e-4])
    operator = replace(qp, P=aslinearoperator(P))
    assert residual(operator, s) == pytest.approx(1e-2 / 100.01, rel=1e-6)
    assert residual(qp, s) == pytest.approx(1e-3 / 10.001, rel=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("where", ["x", "y", "z", "z_box"])
def test_a_point_that_is_not_finite_meets_no_tolerance(where, bad):
    qp, s = block()
    vector = getattr(s, where).copy()
    vector[-1] = bad
    assert not residual(qp, replace(s, **{where: vector})) <= 1e300
