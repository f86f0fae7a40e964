"""The process that reads a Parquet file: arrow ends it at some that are damaged.

::

    python parquetreader.py MOST KEY COLUMN... < FILE

prints a line of JSON with the number of ``rows``, the columns ``missing``, the
``bytes`` that the file declares, at most MOST if it is to be read, and as ``meta`` the
text under KEY in the metadata of its schema. Of a file of one row ``columns`` follows,
the length of each column's list, null where it is null, -1 where it is no list of
numbers; then the numbers of one column after the other, as float64. It imports nothing
of ours, to start fast.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
from typing import Any

import numpy as np
import pyarrow.parquet as pq

CPU_SECONDS = 60  #: after which the kernel ends this process
SECONDS = 600  #: likewise, of waiting for what never comes
ROOM = 2**29  #: bytes of address space beside four times what the file declares


def main(most: int, key: str, wanted: list[str]) -> None:
    """Read standard input, write standard output."""
    # a thread of arrow's may abort Python when it ends
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS))
    signal.alarm(SECONDS)
    file = pq.ParquetFile(sys.stdin.buffer, pre_buffer=False)
    told = file.metadata
    # a page can say "the same value a billion times" in few bytes: values count, too
    groups = [told.row_group(i) for i in range(told.num_row_groups)]
    chunks = [g.column(i) for g in groups for i in range(g.num_columns)]
    size = sum(max(8 * c.num_values, c.total_uncompressed_size) for c in chunks)
    names = file.schema_arrow.names
    meta = (file.schema_arrow.metadata or {}).get(key.encode(), b"{}")
    head: dict[str, Any] = {
        "rows": told.num_rows,
        "missing": [name for name in wanted if name not in names],
        "bytes": size,
        "meta": meta.decode(errors="replace"),
    }
    if told.num_rows != 1 or head["missing"] or size > most:
        print(json.dumps(head))
        return
    _bound(4 * size + ROOM)
    table = file.read(columns=wanted, use_threads=False)
    table.validate(full=True)
    found = {name: _numbers(table.column(name)[0]) for name in wanted}
    head["columns"] = {k: v if v is None else v.size for k, v in found.items()}
    head["columns"] |= {
        k: -1 for k, v in found.items() if v is not None and v.ndim != 1
    }
    print(json.dumps(head), flush=True)
    for values in found.values():
        if values is not None and values.ndim == 1:
            sys.stdout.buffer.write(values.astype("<f8").tobytes())


def _bound(room: int) -> None:
    """Have the kernel refuse memory beyond `room`."""
    with open("/proc/self/statm") as file:
        pages = int(file.read().split()[0])
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    limit = pages * resource.getpagesize() + room
    if hard != resource.RLIM_INFINITY:
        limit = min(limit, hard)
    resource.setrlimit(resource.RLIMIT_AS, (limit, hard))


def _numbers(scalar: Any) -> Any:
    """Take the numbers of a list; None of a null, an array without axes otherwise."""
    if not scalar.is_valid:
        return None
    try:
        values = np.asarray(scalar.values.to_numpy(zero_copy_only=False))
    except (ValueError, TypeError, AttributeError):
        return np.zeros(())
    return values if values.dtype.kind in "iuf" and values.ndim == 1 else np.zeros(())


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], sys.argv[3:])
    sys.stdout.flush()
    os._exit(0)  # without waiting for threads of arrow's, which may not end
