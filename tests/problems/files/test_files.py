"""QPs from files: the QP that is read equals the QP that was written."""

import gzip
import json
import re
from dataclasses import replace

import highspy
import numpy as np
import pandas as pd
import pytest
from scipy.io import loadmat, savemat
from scipy.sparse import (
    csc_array,
    csc_matrix,
    csr_array,
    diags_array,
    eye_array,
    vstack,
)

from mortarbench.harness import QP, InputError
from mortarbench.harness.files.qpfile import explicit_matrices
from mortarbench.harness.names import assemble, parse
from mortarbench.harness.results.journal import read_journal
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.problems.files.qps import parse_qps, save_qps
from mortarbench.problems.files.readers import read
from mortarbench.problems.files.two_sided import loaded
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.cases import built
from tests.support.refusals import refused

#: example from the report of Maros and Mészáros with further rows, ranges and bounds;
#: contains every type of row
QPS = """\
* a comment
NAME          EXAMPLE
ROWS
 N  obj
 G  r1
 L  r2
 E  r3
 N  ignored
 E  r4
COLUMNS
    c1        r1                 2.0   r2                -1.0
    c1        obj                1.5   ignored            7.0
    c2        r1                 1.0   r2                 2.0
    c2        obj               -2.0   r3                 1.0
    c3        r3                 1.0   r4                 1D-14
    c4        r4                 3.0
    c5        r4                 1.0
RHS
    rhs       obj               -4.0   r1                 2.0
    rhs       r2                 6.0   r3                 1.0
RANGES
    rng       r1                 4.0   r3                -2.0
    rng       r2                 2.5
BOUNDS
 UP bnd       c1                20.0
 FR bnd       c3
 MI bnd       c4
 FX bnd       c5                 2.0
QUADOBJ
    c1        c1                 8.0
    c1        c2                 2.0
    c2        c2                10.0
ENDATA
"""


def solved(qp):
    s = SOLVERS["clarabel"].prepare(qp, 1e-10)()
    assert kkt_residuals(qp, s).worst < 1e-8
    return s


@pytest.fixture
def written(tmp_path, monkeypatch):
    """Return a function that writes a file to the working directory and returns its
    case name."""
    monkeypatch.chdir(tmp_path)

    def write(content, name):
        if isinstance(content, dict):
            savemat(tmp_path / name, content)
        else:
            (tmp_path / name).write_text(content)
        return f"file:{name}"

    return write


def assert_same(one, two):
    for name in ("q", "b", "h", "lb", "ub"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    for name in ("P", "A", "G"):
        left, right = (getattr(qp, name) for qp in (one, two))
        assert isinstance(left, np.ndarray) == isinstance(right, np.ndarray)
        np.testing.assert_array_equal(
            csc_array(left).toarray(), csc_array(right).toarray()
        )


# QPS


def test_a_qps_text_defines_the_qp_of_its_sections():
    given = parse_qps(QPS)

    assert not given.maximise
    assert given.r == 4  # the RHS of the objective is −r
    np.testing.assert_array_equal(given.q, [1.5, -2, 0, 0, 0])
    expected = np.zeros((5, 5))
    expected[:2, :2] = [[8, 2], [2, 10]]
    np.testing.assert_array_equal(given.P.toarray(), expected)
    rows = [[2, 1, 0, 0, 0], [-1, 2, 0, 0, 0], [0, 1, 1, 0, 0], [0, 0, 1e-14, 3, 1]]
    np.testing.assert_array_equal(given.A.toarray(), rows)
    np.testing.assert_array_equal(given.l, [2, 3.5, -1, 0])
    np.testing.assert_array_equal(given.u, [6, 6, 1, 0])
    np.testing.assert_array_equal(given.lb, [0, 0, -np.inf, -np.inf, 2])
    np.testing.assert_array_equal(given.ub, [20, np.inf, np.inf, np.inf, 2])


def highs_reads(path):
    highs = highspy.Highs()
    highs.setOptionValue("output_flag", False)
    highs.setOptionValue("small_matrix_value", 1e-12)
    highs.readModel(str(path))
    lp, hessian = highs.getModel().lp_, highs.getModel().hessian_
    n, m = lp.num_col_, lp.num_row_
    parts = lp.a_matrix_
    A = csc_array((parts.value_, parts.index_, parts.start_), shape=(m, n))
    triangle = csc_array((hessian.value_, hessian.index_, hessian.start_), shape=(n, n))
    P = (triangle + triangle.T).toarray() - np.diag(triangle.diagonal())
    vectors = (lp.col_cost_, lp.row_lower_, lp.row_upper_, lp.col_lower_, lp.col_upper_)
    return P, A.toarray(), *map(np.array, vectors), lp.offset_


@pytest.mark.parametrize("section", ["QUADOBJ", "QSECTION obj", "QMATRIX"])
def test_highs_reads_the_same_qp(tmp_path, section):
    text = QPS.replace("1D-14", "0.25").replace("QUADOBJ", section)
    if section == "QMATRIX":
        text = text.replace("c2        c2 ", "c2 c1 2.0\n    c2  c2 ")
    path = tmp_path / "a.mps"
    path.write_text(text)

    given = parse_qps(text)
    ours = (given.P.toarray(), given.A.toarray(), given.q, given.l, given.u,
            given.lb, given.ub, given.r)  # fmt: skip
    for mine, theirs in zip(ours, highs_reads(path), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def awkward(rng, n=7, *, symmetric=True):
    """Return a QP with all kinds of bounds, empty rows and columns, and numbers with
    few or 17 digits."""
    P = rng.standard_normal((n, n))
    P = P @ P.T
    P[:, -1] = P[-1] = 0
    if not symmetric:
        P[0, 1] *= 1 + 2**-50
    A, G = (np.where(rng.random((3, n)) < 0.5, rng.standard_normal((3, n)), 0)
            for _ in range(2))  # fmt: skip
    A[0] = A[:, -1] = G[:, -1] = 0
    inf = np.inf
    return QP(
        P=csc_array(P), q=np.append(rng.standard_normal(n - 1), 0), A=csr_array(A),
        b=np.array([0.0, 1e-300, -0.1]), G=csr_array(G),
        h=np.array([0.0, 1 / 3, -1e19]),
        lb=np.array([0, -inf, -inf, 0.1, -2.0, 1.5, -inf]),
        ub=np.array([inf, inf, -3.0, inf, -1.0, 1.5, 0.0]),
    )  # fmt: skip


def of_symmetric_part(qp):
    """Return the QP with the symmetric part of P, which determines the objective."""
    M = {name: csc_array(M) for name, M in explicit_matrices(qp)[0].items()}
    return replace(qp, **{**M, "P": csc_array((M["P"] + M["P"].T) / 2)}, structure=None)


def test_an_exported_qps_comes_back_to_the_last_digit(tmp_path):
    qp = awkward(np.random.default_rng(31))
    save_qps(tmp_path / "a.qps", qp, {"name": "a case", "two": "lines\nof it"})
    back, scale, constant, _ = read(tmp_path / "a.qps")

    assert_same(qp, back)
    assert (scale, constant) == (1.0, 0.0)


@pytest.mark.parametrize("form", ["primal", "dual", "dual-bounds"])
def test_the_export_of_a_case_as_qps_is_its_qp(written, command, form):
    assert command("export", f"{SMALL}/{form}", "a.qps")[0] == 0
    qp = built(f"{SMALL}/{form}").qp
    back = built("file:a.qps").qp

    assert_same(of_symmetric_part(qp), back)


def test_highs_reads_an_exported_qps(tmp_path):
    """P is symmetric only up to rounding."""
    qp = awkward(np.random.default_rng(32), symmetric=False)
    save_qps(tmp_path / "a.mps", qp, {})
    qp = of_symmetric_part(qp)
    P, rows, q, low, high, lb, ub, constant = highs_reads(tmp_path / "a.mps")

    np.testing.assert_allclose(P, qp.P.toarray(), rtol=1e-15)
    np.testing.assert_array_equal(rows, np.vstack([qp.A.toarray(), qp.G.toarray()]))
    for mine, theirs in [
        (qp.q, q), (qp.lb, lb), (qp.ub, ub), (np.append(qp.b, qp.h), high),
        (np.append(qp.b, np.full(3, -np.inf)), low), (0.0, constant),
    ]:  # fmt: skip
        np.testing.assert_array_equal(mine, theirs)


def test_values_that_qps_treats_as_infinite_are_not_written(tmp_path):
    qp = replace(awkward(np.random.default_rng(33)), h=np.array([0.0, 1.0, 1e20]))

    with pytest.raises(
        InputError, match=r"h contains 1e\+20, but QPS treats 9.99999e\+19"
    ):
        save_qps(tmp_path / "a.qps", qp, {})
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize("name", ["a.qps", "a.MPS", "a.mat"])
def test_a_compressed_file_is_the_file(written, tmp_path, name):
    written(MAT if name == "a.mat" else QPS, name)
    plain = (tmp_path / name).read_bytes()
    (tmp_path / f"{name}.gz").write_bytes(
        gzip.compress(plain[:99]) + gzip.compress(plain[99:])
    )

    assert_same(built(f"file:{name}").qp, built(f"file:{name}.gz").qp)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.npz.gz", "a.npz.gz: .npz.gz is not read; expected .qps.gz or .mps.gz or "),
        ("a.gz", "a.gz: .gz is not read; expected .qps.gz or "),
        ("a.csv", "a.csv: unknown format '.csv'; "),
        ("a.mat", "a.mat: not a .mat file"),
        ("a.qps", "a.qps: not UTF-8"),
    ],
)
def test_files_of_other_formats_are_refused(tmp_path, written, name, message):
    text = written("", name)
    (tmp_path / name).write_bytes(b"\xff\xfe")
    with refused(message):
        built(text)


def test_the_name_of_a_set_may_be_left_out():
    bare = re.sub(r"^    (rhs|rng)", "    ", QPS, flags=re.MULTILINE)
    bare = re.sub(r"^ (UP|FR|MI|FX) bnd", r" \1", bare, flags=re.MULTILINE)
    one, two = parse_qps(QPS), parse_qps(bare)

    assert bare != QPS
    assert_same(loaded(one).qp, loaded(two).qp)


@pytest.mark.parametrize(
    ("old", "new", "limits"),
    [
        ("r1                 4.0", "r1 -4.0", [(2, 6), (3.5, 6), (-1, 1)]),
        ("r2                 2.5", "r2 -2.5", [(2, 6), (3.5, 6), (-1, 1)]),
        ("r3                -2.0", "r3 2.0", [(2, 6), (3.5, 6), (1, 3)]),
    ],
)
def test_the_sign_of_a_range_matters_for_equalities_only(old, new, limits):
    assert old in QPS
    given = parse_qps(QPS.replace(old, new))

    assert list(zip(given.l, given.u, strict=True))[:3] == limits


def test_a_negative_upper_bound_alone_frees_the_lower_side():
    negative = QPS.replace(" UP bnd       c1                20.0", " UP bnd c1 -3")

    assert parse_qps(negative).lb[0] == -np.inf
    both = negative.replace(" UP bnd c1", " LO bnd c1 -5\n UP bnd c1")
    assert parse_qps(both).lb[0] == -5


def qptest(r1="r1", r2="r2", c1="c1", c2="c2", rhs="rhs1", bnd="bnd1"):
    """Return the problem QPTEST of the collection in fixed columns, with given names.

    Its published optimum is 4.371875; here the objective also has the constant 4.
    """

    def line(*fields):
        text = "    {:<10}{:<10}{:>12}   {:<10}{:>12}"
        return text.format(*fields, *[""] * (5 - len(fields))).rstrip()

    lines = [
        "NAME          QPTEST", "ROWS", " N  obj", f" G  {r1}", f" L  {r2}", "COLUMNS",
        line(c1, r1, "2.0", r2, "-1.0"), line(c1, "obj", "1.5"),
        line(c2, r1, "1.0", r2, "2.0"), line(c2, "obj", "-2.0"), "RHS",
        line(rhs, "obj", "-4.0"), line(rhs, r1, "2.0", r2, "6.0"), "BOUNDS",
        f" UP {line(bnd, c1, '20.0')[4:]}", "QUADOBJ", line(c1, c1, "8.0"),
        line(c1, c2, "2.0"), line(c2, c2, "10.0"), "ENDATA",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


QPTEST = qptest()


def value_of(case):
    return case.quantities(solved(case.qp))["value"]


def test_the_published_optimum_of_qptest(written):
    assert value_of(built(written(QPTEST, "a.qps"))) == pytest.approx(8.371875)


@pytest.mark.parametrize(
    ("section", "after", "other"),
    [
        ("BOUNDS", "20.0\n", " UP other     c1  0.5\n"),
        ("RHS", "6.0\n", "    other     r1  3.0\n"),
        ("RANGES", "6.0\n", "RANGES\n    first  r2  99.0\n    other  r1  0.0\n"),
    ],
)
def test_of_several_sets_the_first_is_used_with_a_remark(
    written, section, after, other
):
    """Any other set would change the optimum."""
    text = QPTEST.replace(after, after + other, 1)
    case = built(written(text, "a.qps"))

    assert value_of(case) == pytest.approx(8.371875)
    (remark,) = case.remarks
    assert remark.startswith(f"{section}: the set 'other' is ignored")


@pytest.mark.parametrize(
    "text",
    [
        QPTEST.replace("1.5", "1.5  $ a cost").replace("N  obj", "N  obj  $ first"),
        QPTEST.replace("20.0", "20.0 * a comment").replace("10.0", "10.0 $"),
        f"$ a comment\n* another\n{QPTEST}",
        qptest(r1="$r1", c2="*c2", rhs="$"),
        qptest(r1="row 1", r2="a  row", c1="c 1", c2="1 2", rhs="the rhs", bnd="a b"),
        qptest(r1="row 1").replace("1.5", "1.5   $ a cost"),
        qptest(c1="c 1", rhs="", bnd=""),
    ],
)
def test_comments_and_names_with_spaces_or_special_characters(written, text):
    assert value_of(built(written(text, "a.qps"))) == pytest.approx(8.371875)


def test_names_with_spaces_need_fixed_columns(written):
    text = qptest(c1="c 1").replace(" UP bnd1      c 1", " UP bnd1 c 1")
    with pytest.raises(InputError, match="line 15: column 'bnd1 c 1' is not among COL"):
        built(written(text, "a.qps"))


@pytest.mark.parametrize("line", ["OBJSENSE MAX", "OBJSENSE\n    maximize"])
def test_a_maximised_objective_is_minus_a_minimised_one(written, line):
    concave = QPS.replace("8.0", "-8.0").replace("10.0", "-10.0")
    case = built(written(concave.replace("ROWS", f"{line}\nROWS"), "a.QPS"))
    s = solved(case.qp)

    # maximum of −4c₁² + 2c₁c₂ − 5c₂² + 1.5c₁ − 2c₂ + 4 with r1 and r2 at their lower
    # limits: c₁ = 0.1, c₂ = 1.8
    np.testing.assert_allclose(s.x[:2], [0.1, 1.8], atol=1e-8)
    assert case.quantities(s)["value"] == pytest.approx(-15.33)
    energy = case.scale * case.qp.objective(s.x) + case.constant
    assert energy == pytest.approx(-15.33)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("r4                 3.0", "r9 3.0", "line 16: row 'r9' is not among ROWS"),
        ("    c1        c2  ", "    c1 c9 ", "line 31: column 'c9' is not among COL"),
        ("20.0", "2O.0", "line 25: '2O.0' is not a number"),
        (" UP bnd", " UQ bnd", "line 25: unknown bound type 'UQ'; known: FR, FX, LO"),
        (" UP bnd", " BV bnd", "line 25: bound BV makes the variable discrete"),
        ("RANGES", "RANGE", "line 21: unknown section 'RANGE'; did you mean 'RANGES'?"),
        (" G  r1", " H  r1", "line 5: unknown row type 'H'"),
        (" G  r1", " G  r2", "line 6: row 'r2' is given twice"),
        ("COLUMNS\n", "COLUMNS\n M 'MARKER' 'INTORG'\n", "line 11: integer variables"),
        ("c2        c2 ", "c2 c1 ", "line 32: entry 'c2', 'c1' is given twice"),
        ("QUADOBJ", "QSECTION r1", "line 29: QSECTION 'r1' belongs to a constraint"),
        ("ENDATA\n", "", "no ENDATA; the file is truncated"),
        (" N  obj\n", " G  obj\n", None),
        ("MI bnd       c4", "LO bnd c4 1e20", "the limits of variable 'c4' are inf an"),
        ("FX bnd       c5  ", "UP bnd c5 1\n LO bnd c5 ", "the limits of variable 'c5' "
         "cross: 2 > 1"),
        ("FX bnd       c5  ", "UP bnd c5 1\n UP bnd c5 ", "line 29: bound UP of column "
         "'c5' is given twice"),
        ("ENDATA", "QMATRIX\nENDATA", "line 33: QMATRIX after QUADOBJ; expected one"),
        ("c1        c2 ", "col 1     c2 ", "line 31: wrong number of fields"),
    ],
)  # fmt: skip
def test_a_bad_qps_text_is_refused_with_its_line(written, old, new, message):
    assert old in QPS
    text = QPS.replace(old, new, 1)
    if message is None:
        text, message = text.replace(" N  ignored\n", " G  ignored\n"), "no row of type"
    with refused(start=f"a.qps: {message}"):
        built(written(text, "a.qps"))


# Maros-Mészáros in .mat

HALF = np.array([[2, 0, 1, 0], [1, 3, 0, 0], [0, -1, 2, 1], [0.5, 0, 0, 1]])
ROWS = [[1, 2, 0, -1], [0, 1, 1, 0], [3, 0, -1, 2], [1, 0, 0, 1], [-2, 1, 0.5, 1]]
MAT = {
    "P": csc_matrix(HALF @ HALF.T),
    "q": np.array([[1.0], [-2.0], [0.5], [3.0]]),
    "r": 2.5,
    "A": csc_matrix(np.array(ROWS)),
    "l": np.array([[1.0, -1e20, -2, -1e20, -1]]),
    "u": np.array([[1.0, 3, 1e20, 1e20, 4]]),
    "n": 4,
    "m": 5,
}


def test_two_sided_rows_become_equalities_and_inequalities(written):
    case = built(written(MAT, "a.mat"))
    qp, A = case.qp, MAT["A"].toarray()

    np.testing.assert_array_equal(csc_array(qp.P).toarray(), MAT["P"].toarray())
    np.testing.assert_array_equal(qp.q, MAT["q"].ravel())
    np.testing.assert_array_equal(qp.A.toarray(), A[:1])
    np.testing.assert_array_equal(qp.b, [1])
    np.testing.assert_array_equal(qp.G.toarray(), [A[1], A[4], -A[2], -A[4]])
    np.testing.assert_array_equal(qp.h, [3, 4, 2, 1])
    assert not np.isfinite(qp.lb).any()
    assert not np.isfinite(qp.ub).any()
    s = solved(qp)
    assert case.quantities(s)["value"] == qp.objective(s.x) + 2.5


def test_identity_rows_at_the_end_are_the_bounds(written):
    bounds = np.array([[0.0, -1e20, -1, 2]]), np.array([[1.0, 1e20, 1e20, 2]])
    more = MAT | {
        "A": csc_matrix(vstack([MAT["A"], eye_array(4)])),
        "l": np.hstack([MAT["l"], bounds[0]]),
        "u": np.hstack([MAT["u"], bounds[1]]),
        "m": 9,
    }
    qp = built(written(more, "a.mat")).qp

    assert (qp.b.size, qp.h.size) == (1, 4)
    np.testing.assert_array_equal(qp.lb, [0, -np.inf, -1, 2])
    np.testing.assert_array_equal(qp.ub, [1, np.inf, np.inf, 2])


def test_older_names_and_separate_bounds_are_accepted(written):
    lb, ub = np.array([[0.0, -np.inf, -1, 2]]), np.array([[1.0, 1e20, 1e20, 2]])
    names = {"P": "Q", "q": "c", "l": "rl", "u": "ru", "A": "A"}
    older = {new: MAT[old] for old, new in names.items()} | {"lb": lb, "ub": ub}
    rows = {
        "A": csc_matrix(vstack([MAT["A"], eye_array(4)])), "m": 9,
        "l": np.hstack([MAT["l"], lb]), "u": np.hstack([MAT["u"], ub]),
    }  # fmt: skip

    assert_same(
        built(written(older, "b.mat")).qp, built(written(MAT | rows, "a.mat")).qp
    )


def test_limits_near_1e20_are_infinite(written):
    """A limit of 1e20 may change in its seventh digit when a file is converted."""
    near = MAT | {"l": np.array([[1.0, -9.999_999_9e19, -2, -9.999_995e19, -1]])}

    assert_same(built(written(near, "b.mat")).qp, built(written(MAT, "a.mat")).qp)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"P": csc_matrix(HALF)}, "P is not symmetric: P["),
        ({"P": csc_matrix(np.eye(3))}, "P has shape (3, 3), expected (4, 4)"),
        ({"l": np.full(5, 2.0), "u": np.ones(5)}, "the limits of row 0 (from 0) cross"),
        ({"l": np.full(5, 1e21), "u": np.full(5, 1e21)}, "the limits of row 0"),
        ({"q": np.full(4, np.nan)}, "q[0] is nan; expected a finite number"),
        ({"q": np.full(4, np.inf)}, "q[0] is inf; expected a finite number"),
        ({"lb": np.zeros(3)}, "lb has shape (3,), expected (4,)"),
        (
            {"lb": np.full(4, 3), "ub": np.full(4, 2)},
            "the limits of variable 0 (from 0) cross: 3 > 2",
        ),
        ({"q": "text"}, "q is of type <U4; expected numbers"),
        ({"q": np.eye(4)}, "q is of shape (4, 4); expected one row or column"),
        ({"m": 7}, "m contradicts the other variables; expected 5"),
        ({"u": np.ones(4)}, "u has shape (4,), expected (5,)"),
        ({"A": None}, "A is missing"),
        ({"G": np.eye(4)}, "h is missing, but G is present"),
    ],
)
def test_an_invalid_mat_file_is_named_with_the_error(written, changes, message):
    content = {k: v for k, v in (MAT | changes).items() if v is not None}
    with refused(start=f"a.mat: {message}"):
        built(written(content, "a.mat"))


@pytest.mark.parametrize(
    ("P", "message"),
    [
        (np.diag([1.0, -1.0]), "P[1, 1] = -1; expected a convex QP"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "it has a negative eigenvalue; exp"),
        (
            np.array([[0.0, 1.0], [1.0, 0.0]]) * 1e-310,
            "it has a negative eigenvalue; exp",
        ),
        (
            diags_array([1.0] * 3000 + [-1e-3]),
            "P[3000, 3000] = -0.001; expected a convex",
        ),
    ],
    ids=["concave", "saddle", "small", "large"],
)
def test_a_qp_that_is_not_convex_is_refused(written, P, message):
    """For example, min −½x² over −1 ≤ x ≤ 1 has a KKT point at 0, which is its
    maximum."""
    n = P.shape[0]
    free = {"A": eye_array(n), "l": -np.ones(n), "u": np.ones(n), "q": np.zeros(n)}
    with refused(start=f"a.mat: P is not positive semidefinite: {message}"):
        built(written({"P": csc_matrix(P), **free}, "a.mat"))


@pytest.mark.parametrize(
    "P",
    [
        [[1, 1], [1, 1 - 2e-16]],
        [[1, -1e-17], [-1e-17, -1e-17]],
        [[1e-300, 0], [0, 0]],
        [[1e300, 1e150], [1e150, 1.0]],
        [[0, 0], [0, 0]],
        [[1, 0.333333], [0.333333, 0.111111]],  # rank one, to six digits
    ],
)
def test_rounding_does_not_make_a_semidefinite_p_non_convex(written, P):
    n = len(P)
    free = {"A": eye_array(n), "l": -np.ones(n), "u": np.ones(n), "q": np.ones(n)}

    assert built(written({"P": csc_matrix(np.array(P)), **free}, "a.mat")).qp.q.size


# names


def test_all_after_the_colon_is_the_path_and_the_canonical_name(written):
    text = written(QPS, "a b=c:1.qps")
    family = PROBLEMS["file"]
    name = parse(text, PROBLEMS)

    assert name.params["path"] == "a b=c:1.qps"
    assert str(name) == text
    assert assemble("file", family, {"path": "a b=c:1.qps"}, "qp") == name


def test_the_content_is_part_of_the_case(written):
    text = written(QPS, "a.qps")
    before = parse(text, PROBLEMS)
    written(QPS.replace("20.0", "30.0"), "a.qps")
    after = parse(text, PROBLEMS)

    assert before.params["sha256"] != after.params["sha256"]
    with pytest.raises(InputError, match=r"a\.qps: its content has the digest"):
        before.build(reference_solution)


@pytest.mark.parametrize("text", ["file", "file:", "file/a.npz"])
def test_the_error_for_a_missing_path_states_the_syntax(text):
    with pytest.raises(InputError, match="the path is missing; expected file:PATH"):
        parse(text, PROBLEMS)


# export and back


SMALL = "beam-ring/Nr=2/Nh=1/steps=2"


@pytest.mark.parametrize("suffix", ["npz", "mat", "parquet"])
@pytest.mark.parametrize("form", ["primal", "dual", "dual-bounds"])
def test_an_exported_qp_comes_back_exactly(written, command, form, suffix):
    assert command("export", f"{SMALL}/{form}", f"a.{suffix}")[0] == 0
    original, back = built(f"{SMALL}/{form}"), built(f"file:a.{suffix}")

    assert_same(back.qp, original.qp)
    assert (back.scale, back.constant) == (original.scale, original.constant)
    s = solved(original.qp)
    energy = original.quantities(s)["energy"]
    assert back.quantities(s)["value"] == pytest.approx(energy, rel=1e-6)


def test_a_mat_file_contains_sparse_matrices_named_as_in_npz(written, command):
    command("export", f"{SMALL}/primal", "a.mat")
    stored = loadmat("a.mat")

    assert all(hasattr(stored[name], "tocsc") for name in "PGA")
    assert json.loads(stored["meta"].item())["form"] == "primal"
    assert {"q", "h", "b", "lb", "ub"} < stored.keys()
    assert "F" not in stored


@pytest.mark.parametrize("form", ["dual", "dual-bounds"])
def test_the_dual_s_matrices_satisfy_the_formulas_of_the_paper(written, command, form):
    command("export", f"{SMALL}/primal", "p.mat")
    command("export", f"{SMALL}/{form}", "a.mat")
    p, a = loadmat("p.mat"), loadmat("a.mat")
    K, f = p["P"].toarray(), -p["q"].ravel()
    B, R, F, d, c = (csc_array(a[k]).toarray() for k in "BRFdc")
    if form == "dual":
        inverse = np.linalg.pinv(K, rcond=1e-12)
    else:  # K⁺ is zero at the supports
        free = np.setdiff1d(np.arange(f.size), csr_array(p["A"]).indices)
        inverse = np.zeros_like(K)
        inverse[np.ix_(free, free)] = np.linalg.inv(K[np.ix_(free, free)])

    np.testing.assert_array_equal(F, a["P"].toarray())
    np.testing.assert_array_equal(d, -a["q"])
    # for λ with RᵀBᵀλ = Rᵀf, any generalised inverse is valid
    T = np.linalg.svd(R.T @ B.T)[2][R.shape[1] :] if R.size else np.eye(len(c))
    scale = abs(T @ F @ T.T).max()
    np.testing.assert_allclose(
        T @ F @ T.T, T @ (B @ inverse @ B.T) @ T.T, rtol=0, atol=1e-9 * scale
    )
    feasible = (
        np.linalg.lstsq(R.T @ B.T, R.T @ f, rcond=None)[0] if R.size else 0 * c.T[0]
    )
    left = d.ravel() - F @ feasible
    right = B @ inverse @ f - c.ravel() - B @ inverse @ B.T @ feasible
    np.testing.assert_allclose(T @ left, T @ right, rtol=0, atol=1e-8 * abs(left).max())
    if form == "dual":
        np.testing.assert_allclose(R.T @ B.T, a["A"].toarray(), atol=1e-12)
        assert R.shape[1] == 6
    else:
        assert R.shape == (f.size, 0)


@pytest.fixture
def two_rows(tmp_path, monkeypatch):
    """A Parquet file in the working directory with the minima of ½x² − x and ½x² − 2x,
    which are −½ and −2."""
    monkeypatch.chdir(tmp_path)
    frame = {name: [None, None] for name in ("G", "h", "A", "b", "lb", "ub")}
    frame |= {"P": [[1.0], [1.0]], "q": [[-1.0], [-2.0]], "name": ["one", "two"]}
    pd.DataFrame(frame).to_parquet("two.parquet", index=False)
    return "two.parquet"


def test_a_row_of_a_parquet_file_is_a_case(two_rows):
    first, second = (built(f"file:{two_rows}#{i}") for i in (1, 2))

    assert parse(f"file:{two_rows}#2", PROBLEMS).name == f"file:{two_rows}#2"
    assert value_of(first) == pytest.approx(-0.5)
    assert value_of(second) == pytest.approx(-2.0)
    with pytest.raises(InputError, match=r"two.parquet: has 2 problems; expected two"):
        built(f"file:{two_rows}")


def test_only_parquet_files_have_rows(written):
    with pytest.raises(InputError, match=r"a.qps#2: only Parquet files contain sev"):
        built(f"{written(QPS, 'a.qps')}#2")


@pytest.mark.parametrize("path", ["two.parquet", "*.parquet"])
def test_a_suite_contains_all_rows_of_a_file(two_rows, tmp_path, command, path):
    (tmp_path / "s.toml").write_text(
        'name = "s"\nrepeats = 1\nsolvers = ["clarabel"]\n[[problems]]\n'
        f'family = "file"\nparams = {{ path = "{path}" }}\n'
    )
    assert command("run", "s.toml", "--out", "out", "--quiet")[0] == 0
    records = read_journal(tmp_path / "out")

    assert sorted((r.case, round(r.objective, 6)) for r in records) == [
        ("file:two.parquet#1", -0.5), ("file:two.parquet#2", -2.0)
    ]  # fmt: skip
