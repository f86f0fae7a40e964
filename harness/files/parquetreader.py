"""Process that reads a Parquet file, since damaged ones can crash Arrow.

::

    python parquetreader.py MAX_BYTES KEY PATTERN COLUMN... < FILE

prints a line of JSON with the number of ``rows``, the columns ``missing``, the
``bytes`` that the file declares, and as ``meta`` the text under KEY in the metadata of
its schema. For a file of one row of at most MAX_BYTES, the line also has ``columns``:
the length of each list, null for a null, and -1 for other types, of COLUMN... and of
all columns whose names match PATTERN. Their numbers follow as float64. No other module
of this package is imported, for speed.
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
SECONDS = 600  #: the same for elapsed time: a file may block
ROOM = 2**29  #: bytes of address space beside four times the declared size


def main(max_bytes: int, key: str, pattern: str, wanted: list[str]) -> None:
    """Read the file on standard input, and print its columns."""
    # a thread of Arrow may abort Python when it ends
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS))
    signal.alarm(SECONDS)
    file = pq.ParquetFile(sys.stdin.buffer, pre_buffer=False)
    metadata = file.metadata
    # a page can encode a billion equal values in few bytes: the limit is on values
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    chunks = [g.column(i) for g in groups for i in range(g.num_columns)]
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
    if metadata.num_rows != 1 or head["missing"] or size > max_bytes:
        print(json.dumps(head))
        return
    _bound(4 * size + ROOM)
    wanted = [*wanted, *optional]
    table = file.read(columns=wanted, use_threads=False)
    table.validate(full=True)
    arrays = {name: _numbers(table.column(name)[0]) for name in wanted}
    head["columns"] = {k: v if v is None else v.size for k, v in arrays.items()}
    head["columns"] |= {
        k: -1 for k, v in arrays.items() if v is not None and v.ndim != 1
    }
    print(json.dumps(head), flush=True)
    for values in arrays.values():
        if values is not None and values.ndim == 1:
            sys.stdout.buffer.write(values.astype("<f8").tobytes())


def _bound(room: int) -> None:
    """Limit the address space to `room` bytes more than are in use."""
    with open("/proc/self/statm") as file:
        pages = int(file.read().split()[0])
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    limit = pages * resource.getpagesize() + room
    if hard != resource.RLIM_INFINITY:
        limit = min(limit, hard)
    resource.setrlimit(resource.RLIMIT_AS, (limit, hard))


def _numbers(scalar: Any) -> Any:
    """Return the numbers of a list, None for a null, and a 0-d array otherwise."""
    if not scalar.is_valid:
        return None
    try:
        values = np.asarray(scalar.values.to_numpy(zero_copy_only=False))
    except (ValueError, TypeError, AttributeError):
        return np.zeros(())
    return values if values.dtype.kind in "iuf" and values.ndim == 1 else np.zeros(())


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], sys.argv[3], sys.argv[4:])
    sys.stdout.flush()
    os._exit(0)  # without waiting for threads of Arrow, which may not end
