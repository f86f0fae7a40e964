"""Separate process for reading a Parquet file, since damaged files can crash Arrow.

::

    python parquetreader.py MAX_BYTES KEY PATTERN ROW COLUMN... < FILE

The process prints a line of JSON with the entries

* ``rows``, the number of rows,
* ``missing``, the names among COLUMN... that the file lacks,
* ``bytes``, the size that the file declares for the row group that contains the row ROW
  (counted from 1), and
* ``meta``, the text under KEY in the metadata of the schema.

If the file has the row, lacks no column, and declares at most MAX_BYTES, the line also
has the entry ``columns``. For each COLUMN, and for each column whose name matches
PATTERN, this entry contains the length of the list in the row, null for a null, or -1
for any other type. The numbers of these lists follow the line as float64. To
start quickly, the process imports no other module of this package.
"""

from __future__ import annotations

import json
import os
import re
import resource
import signal
import sys
from typing import Any

import numpy as np
import pyarrow.parquet as pq

CPU_SECONDS = 60  #: CPU time after which the kernel kills this process
#: elapsed time after which the kernel kills this process, since reading may block
SECONDS = 600
#: number of bytes of address space in addition to four times the declared size
ROOM = 2**29


def main(max_bytes: int, key: str, pattern: str, row: int, wanted: list[str]) -> None:
    """Read a row of the Parquet file on standard input, and print its columns."""
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS))
    signal.alarm(SECONDS)
    file = pq.ParquetFile(sys.stdin.buffer, pre_buffer=False)
    metadata = file.metadata
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    ends = np.cumsum([0] + [group.num_rows for group in groups])
    number = int(np.searchsorted(ends, row)) - 1  # of the group that contains the row
    group = groups[number] if 0 <= number < len(groups) else None
    # The number of values is also used, since a page can encode a billion equal values
    # in a few bytes.
    chunks = [] if group is None else map(group.column, range(group.num_columns))
    size = sum(max(8 * c.num_values, c.total_uncompressed_size) for c in chunks)
    names = file.schema_arrow.names
    optional = [name for name in names if re.fullmatch(pattern, name)]
    meta = (file.schema_arrow.metadata or {}).get(key.encode(), b"{}")
    head: dict[str, Any] = {
        "rows": metadata.num_rows,
        "missing": [name for name in wanted if name not in names],
        "bytes": size,
        "meta": meta.decode(errors="replace"),
    }
    if group is None or head["missing"] or size > max_bytes:
        print(json.dumps(head))
        return
    _bound(4 * size + ROOM)
    wanted = [*wanted, *optional]
    table = file.read_row_group(number, columns=wanted, use_threads=False)
    table.validate(full=True)
    i = row - 1 - int(ends[number])
    arrays = {name: _numbers(table.column(name)[i]) for name in wanted}
    head["columns"] = {k: v if v is None else v.size for k, v in arrays.items()}
    head["columns"] |= {
        k: -1 for k, v in arrays.items() if v is not None and v.ndim != 1
    }
    print(json.dumps(head), flush=True)
    for values in arrays.values():
        if values is not None and values.ndim == 1:
            sys.stdout.buffer.write(values.astype("<f8").tobytes())


def _bound(room: int) -> None:
    """Limit the growth of the address space of this process to `room` bytes."""
    with open("/proc/self/statm") as file:
        pages = int(file.read().split()[0])
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    limit = pages * resource.getpagesize() + room
    if hard != resource.RLIM_INFINITY:
        limit = min(limit, hard)
    resource.setrlimit(resource.RLIMIT_AS, (limit, hard))


def _numbers(scalar: Any) -> Any:
    """Return the numbers of a list, None for a null, or a 0-d array for other types."""
    if not scalar.is_valid:
        return None
    try:
        values = np.asarray(scalar.values.to_numpy(zero_copy_only=False))
    except (ValueError, TypeError, AttributeError):
        return np.zeros(())
    return values if values.dtype.kind in "iuf" and values.ndim == 1 else np.zeros(())


if __name__ == "__main__":
    limit, key, pattern, row, *columns = sys.argv[1:]
    main(int(limit), key, pattern, int(row), columns)
    sys.stdout.flush()
    # Do not wait for Arrow's threads, which may never end or may abort Python.
    os._exit(0)
