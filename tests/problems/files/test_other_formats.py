"""QPs of QPLIB and Clarabel: one QP with a published optimum, and malformed files.

The problem is QPTEST of the Maros-Mészáros collection: minimise
4x₁² + 2x₁x₂ + 5x₂² + 1.5x₁ − 2x₂ for 2x₁ + x₂ ≥ 2, −x₁ + 2x₂ ≤ 6, 0 ≤ x and x₁ ≤ 20.
Its published optimum is 4.371875.
"""

import json

import clarabel
import numpy as np
import pytest
from scipy.sparse import csc_array

from mortarbench.harness import InputError
from mortarbench.harness.registry import SolverSpec, resolve
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems.files.readers import read
from mortarbench.solvers import SOLVERS

OPTIMUM = 4.371875
QPLIB = """\
! a comment
QPTEST          # name
CCL             # type
Minimize
2               # variables
2               # constraints
3               # nonzeros in the lower triangle of Q⁰
1 1 8.0         a comment
2 1 2.0
2 2 1D1
0.0             default entry of b⁰
2
1 1.5
2 -2.0
4.0             q⁰
4               entries of the rows
1 1 2.0
1 2 1.0
2 1 -1.0
2 2 2.0
1e20            infinity
-1e20           default lower limit
1
1 2.0
1e20            default upper limit
1
2 6.0
0.0             default lower bound
0
% another comment
1e20            default upper bound
1
1 20.0
0.0             starting points
0
0.0
0
0.0
0
0               names
0
"""
CLARABEL = {
    "P": {"m": 2, "n": 2, "colptr": [0, 1, 3], "rowval": [0, 0, 1],
          "nzval": [8.0, 2.0, 10.0]},
    "q": [1.5, -2.0],
    "A": {"m": 5, "n": 2, "colptr": [0, 4, 7], "rowval": [0, 1, 2, 4, 0, 1, 3],
          "nzval": [-2.0, -1.0, -1.0, 1.0, -1.0, 2.0, -1.0]},
    "b": [-2.0, 6.0, 0.0, 0.0, 20.0],
    "cones": [{"NonnegativeConeT": 2}, {"NonnegativeConeT": 3}],
    "settings": {},
}  # fmt: skip


def value(loaded):
    solver = resolve(SolverSpec(name="clarabel", label="clarabel"), SOLVERS)
    s = solver.prepare(loaded.qp, 1e-10)()
    assert kkt_residuals(loaded.qp, s).worst < 1e-8
    return loaded.scale * loaded.qp.objective(s.x) + loaded.constant


@pytest.fixture
def loaded(tmp_path, monkeypatch):
    """Return a function that writes a file and reads its QP."""
    monkeypatch.chdir(tmp_path)

    def load(content, name):
        path = tmp_path.joinpath(name).relative_to(tmp_path)
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return read(path)

    return load


# QPLIB


def test_a_file_of_qplib_has_the_published_optimum(loaded):
    assert value(loaded(QPLIB, "a.qplib")) == pytest.approx(OPTIMUM + 4)


def test_a_maximised_objective_of_qplib(loaded):
    """The maximum of x₁ + 2x₂ − ½x₂² for 0 ≤ x ≤ 1 is 2.5, at (1, 1)."""
    text = (
        "name\nDCB\nmaximize\n2\n1\n2 2 -1\n1.0\n1\n2 2.0\n0.0\n1e30\n0.0\n0\n1.0\n0\n"
    )
    given = loaded(text, "a.qplib")

    assert value(given) == pytest.approx(2.5)
    assert (given.qp.lb.tolist(), given.qp.ub.tolist()) == ([0, 0], [1, 1])


def test_the_infinity_of_a_qplib_file_is_its_own(loaded):
    text = "name\nLCN\nminimize\n1\n1.0\n0\n0.0\n1e3\n-1e3\n0\n2e3\n0\n"

    assert loaded(text, "a.qplib").qp.sizes["bounds"] == 0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("CCL", "QCL", "line 3: type 'QCL': a nonconvex objective; expected type L, D"),
        ("CCL", "CML", "line 3: type 'CML': variables that are not continuous"),
        ("CCL", "CCQ", "line 3: type 'CCQ': quadratic constraints; expected type N, B"),
        ("CCL", "CC", "line 3: type 'CC'; expected three letters, such as CCL"),
        ("Minimize", "Least", "line 4: unknown sense 'Least'; known: maximize, minimi"),
        ("2 1 2.0", "1 2 2.0", "line 10: Q⁰ has entries above its diagonal"),
        ("2 1 2.0", "3 1 2.0", "line 9: '3' is not an integer from 1 to 2"),
        ("2 1 2.0", "2 1", "line 9: 2 fields; expected 3"),
        ("2 1 2.0", "2 1 2,0", "line 9: '2,0' is not a number"),
        ("1e20            default upper bound\n1\n1 20.0\n", "", "line 38: the file"),
        ("0\n0.0\n0\n0   ", "0\n0.0\n0\n0\n0   ", "line 42: further data; expected"),
        ("2               # variables", "1e9", "line 5: '1e9' is not an integer from"),
        ("2               # variables", "9" * 15, "line 6: its vectors would take 6"),
        ("-1e20  ", "7  ", "the limits of row 1 (from 0) cross: 7 > 6"),
        ("2 2 1D1", "2 2 0.1", "P is not positive semidefinite"),
    ],
)  # fmt: skip
def test_a_bad_qplib_file_is_refused_with_its_line(loaded, old, new, message):
    assert old in QPLIB
    with pytest.raises(InputError) as e:
        loaded(QPLIB.replace(old, new, 1), "a.qplib")
    assert str(e.value).startswith(f"a.qplib: {message}")
    assert "\n" not in str(e.value)


def test_a_truncated_qplib_file_is_refused(loaded):
    lines = QPLIB.splitlines()
    for end in range(1, lines.index("1 20.0") + 1):
        with pytest.raises(InputError, match=r"a\.qplib: line \d+: the file ends here"):
            loaded("\n".join(lines[:end]), "a.qplib")


# Clarabel


def test_a_problem_of_clarabel_has_the_published_optimum(loaded):
    given = loaded(CLARABEL, "a.json")
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    theirs = clarabel.load_from_file("a.json", settings).solve()

    assert value(given) == pytest.approx(OPTIMUM)
    assert theirs.obj_val == pytest.approx(OPTIMUM)


def test_rows_of_zero_cones_are_equalities_and_infinite_rows_are_dropped(loaded):
    cones = [{"NonnegativeConeT": 1}, {"ZeroConeT": 1}, {"NonnegativeConeT": 3}]
    qp = loaded(CLARABEL | {"cones": cones, "b": [-2, 6, 0, 1e20, 20]}, "a.json").qp

    assert (qp.A.toarray().tolist(), qp.b.tolist()) == ([[-1, 2]], [6])
    assert csc_array(qp.G).toarray().tolist() == [[-2, -1], [-1, 0], [1, 0]]
    assert qp.h.tolist() == [-2, 0, 20]


def test_a_problem_of_clarabel_may_store_both_triangles(loaded):
    both = {"m": 2, "n": 2, "colptr": [0, 2, 4], "rowval": [0, 1, 0, 1],
            "nzval": [8, 2, 2, 10]}  # fmt: skip
    P = loaded(CLARABEL | {"P": both}, "a.json").qp.P

    np.testing.assert_array_equal(P.toarray(), [[8, 2], [2, 10]])


LOWER = {"m": 2, "n": 2, "colptr": [0, 2, 3], "rowval": [0, 1, 1], "nzval": [8, 2, 10]}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"P": LOWER}, "P is not symmetric: "),
        ({"P": None}, "P = None; expected a table"),
        ({"P": {**LOWER, "rowval": [0, 1, 7]}}, "P is not a matrix by columns: "),
        ({"P": {**LOWER, "rowval": [0, 1, 0.5]}}, "P is not a matrix by columns: m, n"),
        ({"P": {"m": 2}}, "P has no 'n'; expected a matrix by columns"),
        ({"q": [1, "2"]}, "q is of type <U"),
        ({"q": [1.0]}, "P has shape (2, 2); expected (1, 1)"),
        ({"b": [1.0] * 4}, "b has shape (4,); expected (5,)"),
        ({"cones": [{"NonnegativeConeT": 4}]}, "the cones have 4 rows; expected 5"),
        ({"cones": [{"SecondOrderConeT": 5}]}, "cones contains {'SecondOrderConeT': 5};"
         " expected linear constraints, ZeroConeT or NonnegativeConeT"),
        ({"cones": [{"ZeroConeT": 10**9}]}, "cones contains {'ZeroConeT': 1000000000}"),
        ({"cones": {"ZeroConeT": 5}}, "cones = {'ZeroConeT': 5}; expected a list"),
    ],
)  # fmt: skip
def test_a_bad_problem_of_clarabel_is_refused_in_one_line(loaded, changes, message):
    with pytest.raises(InputError) as e:
        loaded(CLARABEL | changes, "a.json")
    assert str(e.value).startswith(f"a.json: {message}")
    assert "\n" not in str(e.value)


@pytest.mark.parametrize("text", ["[]", "{}", "{", '{"P": NaN}', "[" * 1000])
def test_other_json_is_refused(loaded, text):
    with pytest.raises(InputError, match=r"a\.json: .*expected"):
        loaded(text, "a.json")
