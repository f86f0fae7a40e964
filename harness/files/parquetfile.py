"""QPs in Parquet files, in the format of qpbenchmark's test sets.

Each row of the table is a problem. The columns are ``P, q, G, h, A, b, lb, ub`` (lists
of doubles) and ``name``. All matrices are dense and stored row by row; their number of
columns is the number of components of q. Absent constraints and bounds are null.
qpbenchmark's ``ParquetTestSet`` reads exactly these columns [1]_. Sets other than
bounds, such as discs, are stored in further columns, which qpbenchmark ignores. These
columns have the names of the arrays in `harness.sets.arrays`; index arrays are stored
row by row.

The meta data of `harness.files.qpfile` are stored in the metadata of the schema under
the key ``mortarbench``, which other readers ignore.

References
----------
.. [1] https://github.com/qpsolvers/qpbenchmark, version 2.7.1

"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csc_array, issparse

from mortarbench.harness.errors import InputError, shortened
from mortarbench.harness.files.datafile import (
    check_size,
    json_object,
    max_bytes,
    opened,
)
from mortarbench.harness.files.durable import replacing
from mortarbench.harness.files.qpfile import explicit_matrices, listed_dense
from mortarbench.harness.qp import QP, Matrix, Vector
from mortarbench.harness.sets.arrays import SET_ARRAY, further_sets, set_arrays

_MATRICES = ("P", "G", "A")
_KEY = "mortarbench"
_READER = Path(__file__).with_name("parquetreader.py")
_COLUMNS = ("P", "q", "G", "h", "A", "b", "lb", "ub")
_RIGHT_HAND_SIDE = {"G": "h", "A": "b"}
#: Largest number of entries of a matrix, which occupy 1 GiB. Parquet stores a matrix as
#: one page, and the size of a page in bytes is an int32.
_MAX_ENTRIES = 2**27


def save_parquet(path: Path, qp: QP, meta: Mapping[str, Any]) -> None:
    """Write `qp` to `path`; `meta` is as in `save_qp`, with ``name`` for the problem.

    Raises
    ------
    InputError
        If a matrix is too large for a dense format, or the file cannot be written.

    """
    # imported here, because both modules load slowly and workers do not need them
    import pyarrow as pa
    import pyarrow.parquet as pq

    n = qp.q.size
    rows = {"P": n, "G": qp.h.size, "A": qp.b.size}
    for name, count in rows.items():
        if count * n > _MAX_ENTRIES:
            raise InputError(
                f"{path}: {name} has {count} × {n} entries; a Parquet file stores "
                f"dense matrices of at most {_MAX_ENTRIES} entries; expected .npz or "
                ".mat for a QP of this size"
            )
    matrices, dense = explicit_matrices(qp)
    flat = {"q": qp.q, "P": _flat(matrices["P"])}
    bounds = {"lb": qp.lb, "ub": qp.ub}
    flat |= {name: bound for name, bound in bounds.items() if np.isfinite(bound).any()}
    for name, rhs in _RIGHT_HAND_SIDE.items():
        if rows[name]:
            flat |= {name: _flat(matrices[name]), rhs: getattr(qp, rhs)}
    numbers = pa.list_(pa.float64())
    columns = {name: pa.array([flat.get(name)], numbers) for name in _COLUMNS}
    for name, array in set_arrays(qp.sets[1:]).items():
        columns[name] = pa.array([array.ravel()])
    table = pa.table({**columns, "name": [str(meta.get("name", path.stem))]})
    text = json.dumps({**meta, "dense": dense})
    table = table.replace_schema_metadata({_KEY: text})
    try:
        with replacing(path) as file:
            pq.write_table(table, file, compression="zstd")
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror or e}") from None


def load_parquet(path: Path, row: int | None = None) -> tuple[QP, dict[str, Any]]:
    """Read a QP and its meta data; matrices that were sparse are in CSC format.

    row : row of the problem, counted from 1; None for the only row of a file

    Raises
    ------
    InputError
        If the file is not Parquet, does not have the row, lacks a column, or its
        columns do not define a valid QP.

    """
    head, flat = _read_row(path, row or 1)
    rows = head["rows"]
    if row is None and rows != 1:
        choice = f"{path}#1 or another row up to #{rows}" if rows else "one row"
        raise InputError(f"{path}: has {rows} problems; expected {choice}")
    if row is not None and row > rows:
        raise InputError(f"{path}#{row}: expected a row from 1 to {rows}")
    if missing := head["missing"]:
        raise InputError(
            f"{path}: no column {', '.join(missing)}; expected the columns of a QP"
        )
    check_size(f"{path}: its content", head["bytes"])
    try:
        meta = json_object(head["meta"])
        dense = listed_dense(meta) if "dense" in meta else set(_MATRICES)
        if odd := [name for name, count in head["columns"].items() if count == -1]:
            raise ValueError(f"{odd[0]} is not a list of numbers")
        if flat["P"] is None or flat["q"] is None:
            raise ValueError("P or q is null; expected lists of numbers")
        parts: dict[str, Any] = {name: flat[name] for name in _COLUMNS}
        for name in _MATRICES:
            if parts[name] is not None:
                M = _matrix(name, parts[name], flat["q"].size)
                parts[name] = M if name in dense else csc_array(M)
        sets = {name: part for name, part in flat.items() if SET_ARRAY.fullmatch(name)}
        qp = QP.from_arrays(**parts, sets=further_sets(sets))
    except (ValueError, TypeError, OverflowError) as e:
        raise InputError(f"{path}: {shortened(' '.join(str(e).split()))}") from None
    except InputError as e:
        raise InputError(f"{path}: {e}") from None
    return qp, meta


def count_problems(path: Path) -> int:
    """Return the number of rows of a Parquet file.

    Raises
    ------
    InputError
        If the file is not Parquet.

    """
    return int(_read_row(path, 0)[0]["rows"])


def _read_row(path: Path, row: int) -> tuple[dict[str, Any], dict[str, Vector | None]]:
    """Read the head of a file, and the columns of a row, in a separate process.

    A damaged file may crash Arrow; the separate process protects this process. If the
    file does not have the row, lacks a column or is too large, there are no columns.

    Raises
    ------
    InputError
        If the file is not Parquet.

    """
    reader = [sys.executable, "-I", str(_READER)]
    command = [*reader, str(max_bytes()), _KEY, SET_ARRAY.pattern, str(row), *_COLUMNS]
    with opened(path, "a Parquet file") as file:
        done = subprocess.run(command, stdin=file, capture_output=True, check=False)
    line, _, numbers = done.stdout.partition(b"\n")
    if done.returncode or not line:
        raise InputError(f"{path}: malformed; expected a Parquet file")
    head = json.loads(line)
    flat: dict[str, Vector | None] = {}
    begin = 0
    for name, count in head.get("columns", {}).items():
        end = begin + 8 * max(count or 0, 0)
        flat[name] = None if count is None else np.frombuffer(numbers[begin:end])
        begin = end
    return head, flat


def _matrix(name: str, flat: Vector, n: int) -> Matrix:
    """Check and return the matrix with n columns whose rows `flat` concatenates."""
    if n == 0 or flat.size % n:
        raise ValueError(
            f"{name} has {flat.size} entries; expected rows of {n} entries"
        )
    return flat.reshape(-1, n)


def _flat(M: Matrix) -> Vector:
    """Return the concatenated rows of a matrix as a vector of doubles."""
    return np.asarray(M.toarray() if issparse(M) else M, dtype=float).ravel()
