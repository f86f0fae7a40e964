"""Separate process for reading .mat and Parquet files.

Damaged files can crash the readers of SciPy and Arrow, and small files can declare huge
data::

    python reader.py MAX_BYTES mat < FILE > NPZ
    python reader.py MAX_BYTES parquet KEY PATTERN ROW COLUMN... < FILE > NPZ

Exit codes other than 0 mean that the file is damaged or, with `TOO_LARGE`, that its
data take more than MAX_BYTES. To start quickly, the process imports no other module of
this package.
"""

from __future__ import annotations

import io
import json
import os
import re
import resource
import sys
import warnings
import zipfile
from typing import Any

import numpy as np

CPU_SECONDS = 60  #: CPU time after which the kernel kills this process
#: number of bytes of address space in addition to a multiple of the size of the data
ROOM = 2**29
TOO_LARGE = 3  #: exit code if the data exceed the limit
_PARTS = ("data", "indices", "indptr", "shape")  # of a sparse matrix in an npz file


def mat(max_bytes: int) -> dict[str, Any]:
    """Return the numbers and texts of a .mat file; other variables are left out.

    A sparse matrix M is returned as its CSC parts M_data, M_indices, M_indptr, M_shape.
    """
    from scipy.io import loadmat
    from scipy.sparse import issparse

    arrays: dict[str, Any] = {}
    _bound(3 * max_bytes)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # for instance, a variable that occurs twice
        variables = loadmat(io.BytesIO(sys.stdin.buffer.read()), spmatrix=False)
    for name, value in variables.items():
        if issparse(value) and value.dtype.kind in "biuf":
            M = value.tocsc()
            parts = (M.data, M.indices, M.indptr, np.array(M.shape))
            arrays |= {f"{name}_{k}": v for k, v in zip(_PARTS, parts, strict=True)}
        elif getattr(value, "dtype", np.dtype(object)).kind in "biufU":
            arrays[name] = value
    return arrays


def parquet(
    max_bytes: int, key: str, pattern: str, number: str, *wanted: str
) -> dict[str, Any]:
    """Return a row of a Parquet file by columns, and a JSON text with the name `head`.

    The entries of the text are

    * ``rows``, the number of rows,
    * ``missing``, the names in `wanted` that the file lacks, and
    * ``meta``, the text under `key` in the metadata of the schema.

    The row consists of the lists of numbers in the columns `wanted`, and in those whose
    name matches `pattern`; nulls are left out, and other values are arrays without
    dimensions. Without that row (counted from 1), or without a column, there is only
    the head.
    """
    import pyarrow.parquet as pq

    file = pq.ParquetFile(sys.stdin.buffer, pre_buffer=False)
    metadata, row = file.metadata, int(number)
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    ends = np.cumsum([0] + [group.num_rows for group in groups])
    at = int(np.searchsorted(ends, row)) - 1  # number of the group that has the row
    names = file.schema_arrow.names
    meta = (file.schema_arrow.metadata or {}).get(key.encode(), b"{}")
    missing = [name for name in wanted if name not in names]
    head = {
        "rows": metadata.num_rows,
        "missing": missing,
        "meta": meta.decode(errors="replace"),
    }
    arrays: dict[str, Any] = {"head": np.array(json.dumps(head))}
    if missing or not 0 <= at < len(groups):
        return arrays
    # The number of values is also used, since a page can encode a billion equal values
    # in a few bytes.
    chunks = map(groups[at].column, range(groups[at].num_columns))
    size = sum(max(8 * c.num_values, c.total_uncompressed_size) for c in chunks)
    if size > max_bytes:
        raise MemoryError
    _bound(4 * size)
    columns = [*wanted, *(name for name in names if re.fullmatch(pattern, name))]
    table = file.read_row_group(at, columns=columns, use_threads=False)
    table.validate(full=True)
    for name in columns:
        value = table.column(name)[row - 1 - int(ends[at])]
        if value.is_valid:
            arrays[name] = _numbers(value)
    return arrays


def _numbers(scalar: Any) -> Any:
    """Return the numbers of a list, or an array without dimensions for other types."""
    try:
        values = np.asarray(scalar.values.to_numpy(zero_copy_only=False))
    except (ValueError, TypeError, AttributeError):
        return np.zeros(())
    return values if values.dtype.kind in "iuf" and values.ndim == 1 else np.zeros(())


def _bound(room: int) -> None:
    """Limit the growth of the address space to `room` bytes and `ROOM`."""
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    limits = [k for k in (soft, hard) if k != resource.RLIM_INFINITY]
    resource.setrlimit(
        resource.RLIMIT_AS, (min(used + room + ROOM, *limits, 2**62), hard)
    )


def main(limit: str, kind: str, *arguments: str) -> None:
    """Read the file on standard input, and write its arrays to standard output."""
    max_bytes = int(limit)
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS))
    try:
        arrays = mat(max_bytes) if kind == "mat" else parquet(max_bytes, *arguments)
        if sum(array.nbytes for array in arrays.values()) > max_bytes:
            raise MemoryError
    except MemoryError:
        os._exit(TOO_LARGE)
    with zipfile.ZipFile(sys.stdout.buffer, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as part:
                np.lib.format.write_array(part, array, allow_pickle=False)
    sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
    # Do not wait for Arrow's threads, which may never end or may abort Python.
    os._exit(0)
