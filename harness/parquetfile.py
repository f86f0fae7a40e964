"""One QP in one Parquet file, as qpbenchmark's test sets load it.

A row is a problem, with the columns ``P, q, G, h, A, b, lb, ub`` (lists of doubles) and
``name``. The format knows dense matrices only: each lies there row by row, and has as
many columns as q has components. Absent constraints and bounds are null. qpbenchmark's
``ParquetTestSet`` reads these columns and no others [1]_.

What the format has no place for, the case's `meta` of `harness.qpfile`, follows in the
metadata of the schema under the key ``mortarbench``, where other readers pass it by.

References
----------
.. [1] https://github.com/qpsolvers/qpbenchmark, as of version 2.7.1

"""

from __future__ import annotations

import json
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csc_array, issparse

from harness.datafile import check_size, json_object, opened, parsing
from harness.errors import InputError, shortened
from harness.qp import QP, Matrix, Vector, no_rows
from harness.qpfile import check_symmetric, explicit_matrices, listed_dense

_EXPECTED = "a Parquet file"
_WRONG = "malformed; expected a Parquet file"
_COPIES = 4  #: of what a file declares that its reader may hold
_MATRICES = ("P", "G", "A")
_COLUMNS = ("P", "q", "G", "h", "A", "b", "lb", "ub")
_RIGHT_HAND_SIDE = {"G": "h", "A": "b"}
_KEY = b"mortarbench"
#: entries of a matrix, 1 GiB: a row lies in one page, whose size is an int32
_MOST = 2**27


def save_parquet(path: Path, qp: QP, meta: Mapping[str, Any]) -> None:
    """Write `qp` to `path`; `meta` is as in `save_qp`, its ``name`` names the problem.

    Raises
    ------
    InputError
        When a matrix is too large for a dense format, or the file cannot be written.

    """
    import pyarrow as pa  # late: workers need none of it
    import pyarrow.parquet as pq

    n = qp.q.size
    rows = {"P": n, "G": qp.h.size, "A": qp.b.size}
    for name, count in rows.items():
        if count * n > _MOST:
            raise InputError(
                f"{path}: {name} has {count} × {n} entries, and Parquet holds them "
                f"dense, at most {_MOST}; expected .npz or .mat for a QP of this size"
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
    table = pa.table({**columns, "name": [str(meta.get("name", path.stem))]})
    text = json.dumps({**meta, "dense": dense})
    table = table.replace_schema_metadata({_KEY: text})
    try:
        pq.write_table(table, path, compression="zstd")
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror or e}") from None


def load_parquet(path: Path) -> tuple[QP, dict[str, Any]]:
    """Read a QP and its meta data; matrices that `save_parquet` met sparse are csc.

    Raises
    ------
    InputError
        When the file is no Parquet, holds not exactly one problem, lacks a column, or
        what it holds is no QP.

    """
    import pyarrow.parquet as pq

    with opened(path, _EXPECTED) as file:
        with parsing(path, _WRONG, 0):  # threads of arrow's may abort Python's end
            parquet = pq.ParquetFile(file, pre_buffer=False)
            told = parquet.metadata
            columns = parquet.schema_arrow.names
            size = _declared(told)
        if told.num_rows != 1:
            raise InputError(f"{path}: holds {told.num_rows} problems; expected one row")
        if missing := [name for name in _COLUMNS if name not in columns]:
            raise InputError(
                f"{path}: no column {', '.join(missing)}; expected a problem"
            )
        check_size(f"{path}: what it holds", size)
        with parsing(path, _WRONG, _COPIES * size):
            table = parquet.read(columns=list(_COLUMNS), use_threads=False)
            table.validate(full=True)
    given = {name: table.column(name)[0] for name in _COLUMNS}
    try:
        meta = json_object((table.schema.metadata or {}).get(_KEY, b"{}"))
        dense = listed_dense(meta) if "dense" in meta else set(_MATRICES)
        qp = _qp(given, dense)
        check_symmetric(qp.P)
    except (ValueError, TypeError, OverflowError) as e:
        raise InputError(f"{path}: {shortened(' '.join(str(e).split()))}") from None
    return qp, meta


def _declared(told: Any) -> int:
    """Add up what the parts of a file will take, as its footer has it.

    A page can say "the same value a billion times" in a few bytes, so values count, too.
    """
    groups = [told.row_group(i) for i in range(told.num_row_groups)]
    chunks = [g.column(i) for g in groups for i in range(g.num_columns)]
    return sum(max(8 * c.num_values, c.total_uncompressed_size) for c in chunks)


def _qp(given: Mapping[str, Any], dense: Container[str]) -> QP:
    """Put a QP together from arrow's scalars, which are lists, or null if absent."""
    flat = {name: _numbers(name, scalar) for name, scalar in given.items()}
    if flat["P"] is None or flat["q"] is None:
        raise ValueError("P or q is null; expected lists of numbers")
    n = flat["q"].size
    parts: dict[str, Any] = {"q": flat["q"]}
    for name in _MATRICES:
        M = flat[name]
        parts[name] = no_rows(n) if M is None else _matrix(name, M, n, name in dense)
    for name in _RIGHT_HAND_SIDE.values():
        parts[name] = np.zeros(0) if flat[name] is None else flat[name]
    for name, absent in (("lb", -np.inf), ("ub", np.inf)):
        parts[name] = np.full(n, absent) if flat[name] is None else flat[name]
    return QP(**parts)


def _numbers(name: str, scalar: Any) -> Vector | None:
    if not scalar.is_valid:
        return None
    try:
        values = np.asarray(scalar.values.to_numpy(zero_copy_only=False))
    except (ValueError, TypeError, AttributeError):
        values = np.array("")
    if values.dtype.kind not in "iuf" or values.ndim != 1:
        raise ValueError(f"{name} is no list of numbers")
    return values.astype(float)


def _matrix(name: str, flat: Vector, n: int, dense: bool) -> Matrix:
    """Shape a matrix of n columns that lies there row by row."""
    if n == 0 or flat.size % n:
        raise ValueError(f"{name} has {flat.size} entries; expected rows of {n}")
    if not np.isfinite(flat).all():
        raise ValueError(f"{name} holds NaN or inf; expected finite numbers")
    M = flat.reshape(-1, n)
    return M if dense else csc_array(M)


def _flat(M: Matrix) -> Vector:
    """List the entries row by row."""
    return np.asarray(M.toarray() if issparse(M) else M, dtype=float).ravel()
