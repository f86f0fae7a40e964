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
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import issparse

from mortarbench.harness.errors import InputError
from mortarbench.harness.files.durable import writing
from mortarbench.harness.files.qpfile import (
    explicit_matrices,
    malformed,
    qp_of,
)
from mortarbench.harness.files.reader import read_isolated
from mortarbench.harness.files.reading import opened
from mortarbench.harness.qp import QP, Matrix, Vector
from mortarbench.harness.sets.arrays import SET_ARRAY, set_arrays

_MATRICES = ("P", "G", "A")
_KEY = "mortarbench"
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
    with writing(path) as file:
        pq.write_table(table, file, compression="zstd")


def load_parquet(path: Path, row: int | None = None) -> tuple[QP, dict[str, Any]]:
    """Read a QP and its meta data; matrices that were sparse are in CSC format.

    row : row of the problem, counted from 1; None for the only row of a file

    Raises
    ------
    InputError
        If the file is not Parquet, does not have the row, lacks a column, or its
        columns do not define a valid QP.

    """
    head, arrays = _read_row(path, row or 1)
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
    with malformed(path):
        if odd := [name for name, array in arrays.items() if not array.ndim]:
            raise ValueError(f"{odd[0]} is not a list of numbers")
        if not {"P", "q"} <= arrays.keys():
            raise ValueError("P or q is null; expected lists of numbers")
        for name in arrays.keys() & _MATRICES:
            arrays[name] = _matrix(name, arrays[name], arrays["q"].size)
        return qp_of({**arrays, "meta": np.array(head["meta"])})


def count_problems(path: Path) -> int:
    """Return the number of rows of a Parquet file.

    Raises
    ------
    InputError
        If the file is not Parquet.

    """
    return int(_read_row(path, 0)[0]["rows"])


def _read_row(path: Path, row: int) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Read the head of a file, and the columns of a row, in a separate process."""
    columns = (_KEY, SET_ARRAY.pattern, str(row), *_COLUMNS)
    with opened(path, "a Parquet file") as file:
        wrong = "malformed; expected a Parquet file"
        arrays = read_isolated(file, path, wrong, "parquet", *columns)
    return json.loads(str(arrays.pop("head"))), arrays


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
