"""npz files whose arrays can be mapped into memory instead of being read.

An npz file is a zip archive of npy files. Here they are stored uncompressed and begin,
with their values, at multiples of 64 bytes, so that ``np.load`` reads them like any
others and `mapped` gives arrays that lie in the page cache, shared by all processes.
"""

from __future__ import annotations

import mmap
import os
import zipfile
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

ALIGNMENT = 64
_LOCAL_HEADER = 30  #: bytes before name and extra field of a member
_PADDING = b"\xfe\xca"  #: an extra field that nobody knows, and all skip


def write_mappable(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays so that they can be mapped.

    A file that is there is replaced, not written over: whoever has mapped it keeps what
    it held, while truncating it would kill them by SIGBUS.
    """
    new = path.with_name(f".{path.name}.new")
    try:
        _write(new, arrays)
        os.replace(new, path)
    finally:
        new.unlink(missing_ok=True)


def _write(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    with path.open("wb") as file, zipfile.ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            header = BytesIO()
            stored = np.ascontiguousarray(array).reshape(array.shape)
            npy.write_array_header_1_0(header, npy.header_data_from_array_1_0(stored))
            member = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            start = file.tell() + _LOCAL_HEADER + len(member.filename.encode()) + 4
            lacking = -start % ALIGNMENT  # the npy header is a multiple of 64 itself
            member.extra = _PADDING + lacking.to_bytes(2, "little") + bytes(lacking)
            archive.writestr(member, header.getvalue() + stored.tobytes())


def mapped(path: Path) -> dict[str, NDArray[Any]]:
    """Map every array of a file; writing to one changes a private copy only.

    Raises
    ------
    OSError, ValueError, BadZipFile
        When the file cannot be read or holds something else.

    """
    with path.open("rb") as file:
        memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
        return {m.filename.removesuffix(".npy"): _array(memory, m) for m in members}


def _array(memory: mmap.mmap, member: zipfile.ZipInfo) -> NDArray[Any]:
    """View one member; a compressed or unaligned one would be no array of ours."""
    begin = member.header_offset
    header = memory[begin : begin + _LOCAL_HEADER]
    skip = int.from_bytes(header[26:28], "little") + int.from_bytes(
        header[28:30], "little"
    )
    begin += _LOCAL_HEADER + skip
    if member.compress_type != zipfile.ZIP_STORED or begin % ALIGNMENT:
        raise ValueError(f"{member.filename} cannot be mapped")
    start = BytesIO(memory[begin : min(begin + 4096, begin + member.file_size)])
    npy.read_magic(start)
    shape, fortran, dtype = npy.read_array_header_1_0(start)
    if dtype.hasobject or fortran:
        raise ValueError(f"{member.filename} is no plain array in C order")
    count = int(np.prod(shape, dtype=np.int64))
    if start.tell() + count * dtype.itemsize > member.file_size:
        raise ValueError(f"{member.filename} is truncated")
    if count == 0:
        return np.empty(shape, dtype)
    flat = np.frombuffer(memory, dtype, count, begin + start.tell())
    return flat.reshape(shape)
