"""QPs from arrays: accepted input, and error messages."""

import cvxpy
import numpy as np
import pytest
import qpsolvers
from scipy.sparse import coo_array, csc_matrix, csr_array, eye_array
from scipy.sparse.linalg import aslinearoperator

from mortarbench.harness import QP, InputError

I2, ZERO = np.eye(2), np.zeros(2)
UPPER = np.array([[2.0, 1.0], [0.0, 2.0]])


@pytest.mark.parametrize("kind", [np.asarray, csc_matrix, csr_array, coo_array, list])
def test_dense_and_sparse_matrices_define_the_same_qp(kind):
    P, G = np.array([[2.0, 1.0], [1.0, 3.0]]), np.array([[1.0, 1.0], [0.0, 2.0]])
    as_kind = (lambda M: M.tolist()) if kind is list else kind
    qp = QP.from_arrays(as_kind(P), [1, 2], as_kind(G), [3, 4], as_kind(G[:1]), [5])
    x = np.array([0.5, -1.0])

    assert qp.objective(x) == 0.5 * x @ P @ x + np.array([1, 2]) @ x
    assert (qp.P @ x).tolist() == (P @ x).tolist()
    assert (qp.G @ x).tolist() == (G @ x).tolist()
    assert (qp.A @ x).tolist() == (G[:1] @ x).tolist()
    assert (qp.h.tolist(), qp.b.tolist()) == ([3, 4], [5])


def test_absent_arguments_yield_no_rows_and_infinite_bounds():
    qp = QP.from_arrays(I2, ZERO)

    assert (qp.A.shape, qp.G.shape, qp.b.size, qp.h.size) == ((0, 2), (0, 2), 0, 0)
    assert (qp.lb == -np.inf).all()
    assert (qp.ub == np.inf).all()


def test_a_scalar_bounds_every_variable_and_a_vector_is_one_row():
    qp = QP.from_arrays(I2, ZERO, G=[1, 2], h=3, lb=0, ub=[1, np.inf])

    assert (qp.lb.tolist(), qp.ub.tolist()) == ([0, 0], [1, np.inf])
    assert (qp.G.tolist(), qp.h.tolist()) == ([[1, 2]], [3])


@pytest.mark.parametrize("kind", [np.array, csc_matrix])
def test_the_passed_arrays_stay_writable_and_are_copied(kind):
    P, q = kind(I2), np.ones(2)
    qp = QP.from_arrays(P, q)
    P[0, 0], q[0] = 7, 7

    assert qp.P.diagonal().tolist() == [1, 1]
    assert qp.q.tolist() == [1, 1]


def test_a_qp_shows_its_sizes():
    qp = QP.from_arrays(I2, ZERO, A=[1, 1], b=1, lb=0)

    assert repr(qp) == "<QP: 2 variables, 1 equalities, 0 inequalities, 2 bounds>"


WHOLE = r"expected both triangles: P \+ P.T - diag\(diag\(P\)\)"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"P": UPPER}, f"P is not symmetric.*{WHOLE}"),
        ({"P": csc_matrix(UPPER)}, WHOLE),
        ({"P": UPPER.T}, WHOLE),
        ({"P": [[1, 2], [3, 4]]}, r"P\[0, 1\] and P\[1, 0\] differ by 1;"),
        ({"P": -I2}, r"P is not positive semidefinite: P\[0, 0\] = -1; expected a con"),
        ({"P": [[1, 2], [2, 1]]}, "it has a negative eigenvalue; expected a convex QP"),
        ({"P": None}, "P is missing; expected an array of numbers"),
        ({"P": np.eye(3)}, r"P has shape \(3, 3\); expected \(2, 2\)"),
        ({"P": np.nan * I2}, r"P\[0, 0\] is nan; expected a finite number"),
        ({"P": csc_matrix(np.diag([1, np.inf]))}, r"P\[1, 1\] is inf; expected a fin"),
        ({"P": 1j * I2}, "P is of type complex128; expected an array of numbers"),
        ({"P": csc_matrix(1j * I2)}, "P is of type complex128; expected an array"),
        ({"P": [[1, 2], [3]]}, "P is ragged; expected an array of numbers"),
        ({"P": "P"}, "P is of type <U1; expected an array of numbers"),
        ({"P": aslinearoperator(I2)}, r"expected a matrix: P @ np.eye\(2\)"),
        ({"q": None}, "q is missing"),
        ({"q": []}, "q is empty; expected at least one variable"),
        ({"q": 1.0}, r"q has shape \(\); expected one dimension"),
        ({"q": [1, np.nan]}, r"q\[1\] is nan; expected a finite number"),
        ({"q": {1: 2}}, "q is of type dict"),
        ({"G": I2}, "h is missing, but G is present"),
        ({"h": ZERO}, "G is missing, but h is present"),
        ({"A": I2}, "b is missing, but A is present"),
        ({"b": ZERO}, "A is missing, but b is present"),
        (
            {"G": np.ones((2, 3)), "h": ZERO},
            r"G has shape \(2, 3\); expected \(rows, 2",
        ),
        ({"A": [1, 1], "b": ZERO}, "b has 2 entries; expected 1, one per row of A"),
        ({"G": I2, "h": [np.inf, np.nan]}, r"h\[1\] is nan; expected a finite"),
        ({"G": I2, "h": [1, -1e20]}, r"h\[1\] is -inf; expected a finite number"),
        ({"A": I2, "b": [1, np.inf]}, r"b\[1\] is inf; expected a finite number"),
        ({"lb": [0, 0, 0]}, r"lb has shape \(3,\); expected \(2,\)"),
        ({"lb": np.nan}, r"lb\[0\] is nan; expected a number below inf"),
        ({"lb": [0, 1e20]}, r"lb\[1\] is inf; expected a number below inf"),
        ({"ub": [0, -1e20]}, r"ub\[1\] is -inf; expected a number above -inf"),
        ({"lb": [0, 3], "ub": 2}, "bounds cross at 1: 3 > 2; expected lb ≤ ub"),
        ({"lb": "low"}, "lb is of type <U3"),
        ({"sets": (1,)}, "expected a tuple of convex sets in addition to lb"),
    ],
)
def test_invalid_qp_data_are_refused_in_one_line(changes, message):
    with pytest.raises(InputError, match=message) as e:
        QP.from_arrays(**{"P": I2, "q": ZERO, **changes})
    assert "\n" not in str(e.value)


@pytest.mark.parametrize("kind", [np.array, csc_matrix])
def test_limits_near_1e20_are_infinite_and_unlimited_rows_are_dropped(kind):
    """1e20·(1 − 1e-7), as 1e20 after scaling and rounding, is infinite; 1e19 is not."""
    near = 1e20 * (1 - 1e-7)
    qp = QP.from_arrays(
        I2, ZERO, kind([[1, 2], [3, 4], [5, 6]]), [np.inf, 1e19, near],
        lb=[-near, -1e19], ub=[1e19, near],
    )  # fmt: skip

    assert (csc_matrix(qp.G).toarray().tolist(), qp.h.tolist()) == ([[3, 4]], [1e19])
    assert (qp.lb.tolist(), qp.ub.tolist()) == ([-np.inf, -1e19], [1e19, np.inf])
    assert QP.from_arrays(I2, ZERO, [1, 1], np.inf, lb=-1e20).sizes["bounds"] == 0


def test_a_problem_of_qpsolvers_has_the_same_parts():
    parts = dict(
        P=I2, q=np.array([1.0, -2.0]), G=csc_matrix([[1.0, 1.0]]), h=np.array([3.0]),
        A=np.array([1.0, -1.0]), b=np.array([0.5]), lb=np.array([0.0, -np.inf]),
    )  # fmt: skip
    qp = QP.from_qpsolvers(qpsolvers.Problem(**parts))

    for name in ("q", "h", "b", "lb"):
        assert getattr(qp, name).tolist() == parts[name].tolist()
    assert (qp.P.tolist(), qp.A.tolist()) == (I2.tolist(), [[1, -1]])
    assert (qp.G.toarray().tolist(), qp.ub.tolist()) == ([[1, 1]], [np.inf] * 2)


@pytest.mark.parametrize("reason", ["concave", "cone", "integer", "no value"])
def test_a_problem_of_cvxpy_that_is_no_qp_is_refused_in_one_line(reason):
    x, level = cvxpy.Variable(2, integer=reason == "integer"), cvxpy.Parameter()
    objective = {"concave": -cvxpy.sum_squares(x), "cone": cvxpy.norm(x)}
    rows = [x >= level] if reason == "no value" else []
    function = objective.get(reason, cvxpy.sum_squares(x))

    message = r"cvxpy cannot compile .*; expected a convex|parameter .* has no value"
    with pytest.raises(InputError, match=message) as e:
        QP.from_cvxpy(cvxpy.Problem(cvxpy.Minimize(function), rows))
    assert "\n" not in str(e.value)


def test_a_semidefinite_matrix_is_convex_up_to_rounding():
    rng = np.random.default_rng(5)
    B = rng.standard_normal((40, 3))

    assert QP.from_arrays(B @ B.T, np.zeros(40)).q.size == 40
    assert QP.from_arrays(eye_array(600) * 0, np.zeros(600)).q.size == 600
