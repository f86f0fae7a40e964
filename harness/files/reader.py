"""Reading of .mat and Parquet files in a separate process.

Damaged files can crash the readers of SciPy and Arrow, and small files can declare huge
data::

    python -m mortarbench.harness.files.reader MAX_BYTES mat < FILE > NPZ
    python -m mortarbench.harness.files.reader MAX_BYTES parquet KEY PATTERN ROW COLUMN…

Exit codes other than 0 mean that the file is damaged or, with `_TOO_LARGE`, that its
data take more than MAX_BYTES.
"""

from __future__ import annotations

import io
import json
import os
import re
import resource
import subprocess
import sys
import warnings
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.errors import InputError
from mortarbench.harness.files.datafile import at_most
from mortarbench.harness.files.npz import arrays_in
from mortarbench.harness.files.reading import MIB, VARIABLE, max_bytes

_CPU_SECONDS = 60  #: CPU time after which the kernel kills the process
#: address space in addition to a multiple of the largest size of the data
_ROOM = 2**29
_TOO_LARGE = 3  #: exit code if the data exceed the limit
_PARTS = ("data", "indices", "indptr", "shape")  # of a sparse matrix in an npz file


def read_isolated(
    file: IO[bytes], path: Path, wrong: str, *arguments: str
) -> dict[str, NDArray[Any]]:
    """Read the arrays of a file in a separate process that a damaged file may crash.

    file : open file, from its beginning
    path : path of the file for messages
    wrong : message if the file cannot be read
    arguments : arguments of the process, its limit excepted

    Raises
    ------
    InputError
        If the file cannot be read, or its data exceed the limit of
        `harness.files.reading`.

    """
    most = max_bytes()
    command = [sys.executable, "-P", "-m", __name__, str(most), *arguments]
    with TemporaryFile() as archive:
        done = subprocess.run(
            command, stdin=file, stdout=archive, stderr=subprocess.DEVNULL, check=False
        )
        if done.returncode == _TOO_LARGE:
            raise InputError(
                f"{path}: its content would take more than {most // MIB} MiB of "
                f"memory; expected less (set {VARIABLE} to allow more)"
            )
        if done.returncode:
            raise InputError(f"{path}: {wrong}")
        archive.seek(0)
        try:
            return arrays_in(archive, path)
        except ValueError:  # damaged names
            raise InputError(f"{path}: {wrong}") from None


def _mat() -> dict[str, Any]:
    """Return the numbers and texts of a .mat file; other variables are left out.

    A sparse matrix M is returned as its CSC parts M_data, M_indices, M_indptr, M_shape.
    """
    from scipy.io import loadmat
    from scipy.sparse import issparse

    arrays: dict[str, Any] = {}
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


def _parquet(
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


def main(limit: str, kind: str, *arguments: str) -> None:
    """Read the file on standard input, and write its arrays to standard output."""
    most = int(limit)
    resource.setrlimit(resource.RLIMIT_CPU, (_CPU_SECONDS, _CPU_SECONDS))
    try:
        with at_most(4 * most + _ROOM):
            arrays = _mat() if kind == "mat" else _parquet(most, *arguments)
        if sum(array.nbytes for array in arrays.values()) > most:
            raise MemoryError
    except MemoryError:
        os._exit(_TOO_LARGE)
    np.savez(sys.stdout.buffer, **arrays)
    sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
    # Do not wait for Arrow's threads, which may never end or may abort Python.
    os._exit(0)
