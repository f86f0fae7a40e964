"""One QP in one Parquet file, as qpbenchmark's test sets load it.

A row is a problem, with the columns ``P, q, G, h, A, b, lb, ub`` (lists of doubles) and
``name``. The format knows dense matrices only: each lies there row by row, and has as
many columns as q has components. Absent constraints and bounds are null. qpbenchmark's
``ParquetTestSet`` reads these columns and no others [1]_.

What the format has no place for, the case's `meta` of `harness.files.qpfile`, follows
in the metadata of the schema under the key ``mortarbench``, where other readers pass it
by.

References
----------
.. [1] https://github.com/qpsolvers/qpbenchmark, as of version 2.7.1

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
    most_bytes,
    opened,
)
from mortarbench.harness.files.durable import replacing
from mortarbench.harness.files.qpfile import explicit_matrices, listed_dense
from mortarbench.harness.qp import QP, Matrix, Vector, check_symmetric, no_rows

_MATRICES = ("P", "G", "A")
_KEY = "mortarbench"
_READER = Path(__file__).with_name("parquetreader.py")
_COLUMNS = ("P", "q", "G", "h", "A", "b", "lb", "ub")
_RIGHT_HAND_SIDE = {"G": "h", "A": "b"}
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
        with replacing(path) as file:
            pq.write_table(table, file, compression="zstd")
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
    flat, text = _columns(path)
    try:
        meta = json_object(text)
        dense = listed_dense(meta) if "dense" in meta else set(_MATRICES)
        P, q = flat["P"], flat["q"]
        if P is None or q is None:
            raise ValueError("P or q is null; expected lists of numbers")
        n = q.size
        parts: dict[str, Any] = {"q": q}
        for name in _MATRICES:
            M = flat[name]
            parts[name] = (
                no_rows(n) if M is None else _matrix(name, M, n, name in dense)
            )
        for name in _RIGHT_HAND_SIDE.values():
            parts[name] = np.zeros(0) if (rhs := flat[name]) is None else rhs
        for name, absent in (("lb", -np.inf), ("ub", np.inf)):
            bound = flat[name]
            parts[name] = np.full(n, absent) if bound is None else bound
        qp = QP(**parts)
        check_symmetric(qp.P)
    except (ValueError, TypeError, OverflowError) as e:
        raise InputError(f"{path}: {shortened(' '.join(str(e).split()))}") from None
    return qp, meta


def _columns(path: Path) -> tuple[dict[str, Vector | None], str]:
    """Have `harness.files.parquetreader` read the columns, and what lies under our key.

    Raises
    ------
    InputError
        When the file is no Parquet, not of one row, too large, or lacks a column.

    """
    command = [sys.executable, "-I", str(_READER), str(most_bytes()), _KEY]
    with opened(path, "a Parquet file") as file:
        done = subprocess.run(
            [*command, *_COLUMNS], stdin=file, capture_output=True, check=False
        )
    line, _, numbers = done.stdout.partition(b"\n")
    if done.returncode or not line:
        raise InputError(f"{path}: malformed; expected a Parquet file")
    told = json.loads(line)
    if told["rows"] != 1:
        raise InputError(f"{path}: holds {told['rows']} problems; expected one row")
    if missing := told["missing"]:
        raise InputError(f"{path}: no column {', '.join(missing)}; expected a problem")
    check_size(f"{path}: what it holds", told["bytes"])
    flat: dict[str, Vector | None] = {}
    begin = 0
    for name, count in told["columns"].items():
        if count == -1:
            raise InputError(f"{path}: {name} is no list of numbers")
        end = begin + 8 * (count or 0)
        flat[name] = None if count is None else np.frombuffer(numbers[begin:end])
        begin = end
    return flat, told["meta"]


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
