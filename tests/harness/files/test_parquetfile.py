"""QPs in Parquet files have the format of qpbenchmark's test sets."""

import subprocess
import sys

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.sparse import csc_array, csr_array, eye_array, issparse
from scipy.sparse.linalg import aslinearoperator

from mortarbench.harness import QP, InputError, no_rows
from mortarbench.harness.files.parquetfile import (
    count_problems,
    load_parquet,
    save_parquet,
)

P = np.array([[2.0, 1.0, 0.0], [1.0, 3.0, 0.0], [0.0, 0.0, 0.0]])
COLUMNS = ("P", "q", "G", "h", "A", "b", "lb", "ub", "name")


def make_qp(P=P, **changes):
    parts = dict(
        P=P, q=np.array([1.0, -2.0, 0.5]), A=no_rows(3), b=np.zeros(0),
        G=csr_array([[0.0, 1.0, -1.0], [5.0, 0.0, 0.0]]), h=np.array([4.0, 6.0]),
        lb=np.array([-np.inf, 0.0, -1.0]), ub=np.full(3, np.inf),
    )  # fmt: skip
    return QP(**(parts | changes))


def problem_of(row):
    """Build a problem like qpbenchmark's ParquetTestSet, following its documentation.

    Every entry is an array, a string or None. P, G and A are reshaped such that their
    number of columns is the size of q.
    """
    n = row["q"].size
    arrays = {key: row[key] for key in COLUMNS if isinstance(row[key], np.ndarray)}
    shaped = {
        key: array.reshape((array.size // n, n)) if key in "PGA" else array
        for key, array in arrays.items()
    }
    others = {key: row[key] for key in COLUMNS if key not in arrays}
    assert all(value is None or isinstance(value, str) for value in others.values())
    return others | shaped


@pytest.fixture
def path(tmp_path):
    return tmp_path / "qp.parquet"


@pytest.mark.parametrize("kind", [csr_array, csc_array, np.asarray, aslinearoperator])
def test_a_test_set_of_qpbenchmark_finds_the_problem(path, kind):
    save_parquet(path, make_qp(kind(P)), {"name": "three"})
    frame = pd.read_parquet(path, engine="pyarrow")
    (problem,) = (problem_of(row) for _, row in frame.iterrows())

    assert tuple(frame.columns) == COLUMNS
    assert problem["name"] == "three"
    np.testing.assert_array_equal(problem["P"], P)
    np.testing.assert_array_equal(problem["G"], [[0, 1, -1], [5, 0, 0]])
    np.testing.assert_array_equal(problem["q"], [1, -2, 0.5])
    np.testing.assert_array_equal(problem["h"], [4, 6])
    np.testing.assert_array_equal(problem["lb"], [-np.inf, 0, -1])
    assert problem["A"] is problem["b"] is problem["ub"] is None


def test_matrices_come_back_sparse_or_dense_as_they_were(path):
    save_parquet(path, make_qp(), {"scale": -2.0})
    qp, meta = load_parquet(path)

    assert meta == {"scale": -2.0, "dense": ["P"]}
    assert isinstance(qp.P, np.ndarray)
    assert issparse(qp.G)
    np.testing.assert_array_equal(qp.G.toarray(), [[0, 1, -1], [5, 0, 0]])
    assert qp.A.shape == (0, 3)
    np.testing.assert_array_equal(qp.ub, np.full(3, np.inf))


def test_a_problem_written_by_other_software_is_dense(path):
    """A file of pandas has flattened matrices, None for absent data, and no
    metadata.
    """
    row = {"P": P.ravel(), "q": np.ones(3), "G": None, "h": None, "name": "theirs"}
    row |= {"A": np.ones(3), "b": np.array([2.0]), "lb": None, "ub": np.ones(3)}
    pd.DataFrame({k: [v] for k, v in row.items()}).to_parquet(path, index=False)
    qp, meta = load_parquet(path)

    assert meta == {}
    assert isinstance(qp.P, np.ndarray)
    assert isinstance(qp.A, np.ndarray)
    assert qp.G.shape == (0, 3)
    np.testing.assert_array_equal(qp.A, [[1, 1, 1]])
    np.testing.assert_array_equal(qp.lb, np.full(3, -np.inf))


def test_a_matrix_too_large_for_a_dense_format_is_refused_before_allocation(path):
    n = 20_000
    large = QP(
        P=eye_array(n, format="csc"), q=np.ones(n), A=no_rows(n), b=np.zeros(0),
        G=no_rows(n), h=np.zeros(0), lb=np.full(n, -np.inf), ub=np.full(n, np.inf),
    )  # fmt: skip
    with pytest.raises(InputError, match=r"20000 × 20000 entries.*expected \.npz or"):
        save_parquet(path, large, {})
    assert not path.exists()


def columns(**changes):
    row = {"P": [1.0], "q": [1.0], "G": None, "h": None, "A": None, "b": None,
           "lb": None, "ub": None} | changes  # fmt: skip
    return {name: [value] for name, value in row.items() if value != "left out"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"P": [1.0] * 3, "q": [1.0, 1.0]},
            "P has 3 entries; expected rows of 2 entries",
        ),
        ({"P": ["one"]}, "P is not a list of numbers"),
        ({"q": None}, "P or q is null"),
        ({"ub": "left out"}, "no column ub"),
    ],
)
def test_a_file_without_a_problem_is_refused_in_one_line(path, changes, message):
    pq.write_table(pa.table(columns(**changes)), path)
    with pytest.raises(InputError, match=message) as caught:
        load_parquet(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def several(path, count, group):
    """Write min ½x² − ix for i = 0, 1, …, in row groups of the given size."""
    tables = [pa.table(columns(q=[-float(i)], G=[1.0], h=[9.0])) for i in range(count)]
    rows = pa.concat_tables(tables) if count else pa.table(columns()).slice(0, 0)
    pq.write_table(rows, path, row_group_size=group)


@pytest.mark.parametrize("group", [1, 2, 5])
def test_a_row_of_several_problems_is_read(path, group):
    several(path, 5, group)

    assert count_problems(path) == 5
    assert [load_parquet(path, i + 1)[0].q.tolist() for i in range(5)] == [
        [-i] for i in range(5)
    ]
    with pytest.raises(InputError, match=r"qp.parquet#6: expected a row from 1 to 5"):
        load_parquet(path, 6)


@pytest.mark.parametrize(
    ("rows", "choice"), [(0, "one row"), (2, ".*qp.parquet#1 or another row up to #2")]
)
def test_several_problems_need_a_row(path, rows, choice):
    several(path, rows, 1)
    with pytest.raises(InputError, match=f"has {rows} problems; expected {choice}$"):
        load_parquet(path)


def test_invalid_and_missing_files_are_refused(path, tmp_path):
    path.write_bytes(b"PAR1 this is none")
    with pytest.raises(InputError, match="malformed; expected a Parquet file"):
        load_parquet(path)
    with pytest.raises(InputError, match="No such file"):
        load_parquet(tmp_path / "missing.parquet")
    with pytest.raises(InputError, match="cannot be written"):
        save_parquet(tmp_path / "missing" / "qp.parquet", make_qp(), {})


def test_reading_starts_no_threads_that_could_outlive_python(path):
    """Threads of Arrow occasionally abort a process at its exit."""
    save_parquet(path, make_qp(), {})
    program = (
        "import os, pathlib, sys; import pyarrow.parquet; "
        "from mortarbench.harness.files.parquetfile import load_parquet; "
        "threads = len(os.listdir('/proc/self/task')); "
        "load_parquet(pathlib.Path(sys.argv[1])); "
        "print(len(os.listdir('/proc/self/task')) - threads)"
    )
    command = [sys.executable, "-c", program, path]
    done = subprocess.run(command, check=True, capture_output=True, text=True)

    assert done.stdout == "0\n"
