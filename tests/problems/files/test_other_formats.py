"""QPs of Clarabel: one QP with a published optimum, and malformed files.

The problem is QPTEST of the Maros-Mészáros collection: minimise
4x₁² + 2x₁x₂ + 5x₂² + 1.5x₁ − 2x₂ for 2x₁ + x₂ ≥ 2, −x₁ + 2x₂ ≤ 6, 0 ≤ x and x₁ ≤ 20.
Its published optimum is 4.371875.
"""

import json
from pathlib import Path

import clarabel
import numpy as np
import pytest
from scipy.sparse import csc_array

from mortarbench.harness import InputError
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems.files.readers import read
from mortarbench.solvers import SOLVERS
from tests.support.refusals import refused

OPTIMUM = 4.371875
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
    s = SOLVERS["clarabel"].prepare(loaded.qp, 1e-10)()
    assert kkt_residuals(loaded.qp, s).worst < 1e-8
    return loaded.scale * loaded.qp.objective(s.x) + loaded.constant


@pytest.fixture
def loaded(tmp_path, monkeypatch):
    """Return a function that writes a file and reads its QP."""
    monkeypatch.chdir(tmp_path)

    def load(content, name):
        text = content if isinstance(content, str) else json.dumps(content)
        Path(name).write_text(text)
        return read(Path(name))

    return load


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
    with refused(start=f"a.json: {message}"):
        loaded(CLARABEL | changes, "a.json")


@pytest.mark.parametrize("text", ["[]", "{}", "{", '{"P": NaN}', "[" * 1000])
def test_other_json_is_refused(loaded, text):
    with pytest.raises(InputError, match=r"a\.json: .*expected"):
        loaded(text, "a.json")
