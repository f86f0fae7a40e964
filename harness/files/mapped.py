"""Files of arrays that the processes of a run map into memory.

The values of each array are aligned to 64 bytes. Behind them, the file ends with a JSON
list of (name, dtype, shape, offset) and with the offset of this list as 8 bytes. Mapped
values are in the page cache, which all processes share. The content is not checked, so
the digest of a file has to be checked before it is mapped.
"""

from __future__ import annotations

import json
import mmap
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.digest import hex_digest, pieces
from mortarbench.harness.files.durable import replacing

#: size of a cache line in bytes; misaligned arrays would affect measured times
ALIGNMENT = 64
_OFFSET_BYTES = 8


def write_mapped(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays to a file that can be mapped.

    An existing file is replaced, not truncated: truncation would raise SIGBUS in any
    process that has mapped the file.
    """
    entries = []
    with replacing(path) as file:
        for name, array in arrays.items():
            file.write(bytes(-file.tell() % ALIGNMENT))
            entries.append((name, array.dtype.str, array.shape, file.tell()))
            file.write(array.tobytes())
        end = file.tell().to_bytes(_OFFSET_BYTES, "little")
        file.write(json.dumps(entries).encode() + end)


def content_digest(path: Path) -> str:
    """Return 24 hex digits of the SHA-256 of a file's content.

    The file is read again only if its inode, size or time have changed.
    """
    status = path.stat()
    return _digest(path, status.st_ino, status.st_size, status.st_mtime_ns)


@cache
def _digest(path: Path, *_version: int) -> str:
    with path.open("rb") as file:
        return hex_digest(pieces(file), 24)


def read_mapped(path: Path) -> dict[str, NDArray[Any]]:
    """Map all arrays of a file; assignments change only a private copy of the page."""
    with path.open("rb") as file:
        memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    begin = int.from_bytes(memory[-_OFFSET_BYTES:], "little")
    return {
        name: np.ndarray(shape, dtype, memory, offset)
        for name, dtype, shape, offset in json.loads(memory[begin:-_OFFSET_BYTES])
    }
