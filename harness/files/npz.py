"""Npz files whose arrays can be mapped into memory.

An npz file is a zip archive of npy files. This module writes the npy files without
compression and aligns their values to 64 bytes. ``np.load`` can read the resulting npz
file. `mapped` returns arrays whose values are in the page cache, which all processes
share.
"""

from __future__ import annotations

import mmap
import pickle
import zipfile
from collections.abc import Mapping
from io import BytesIO
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from mortarbench.harness.errors import InputError, shortened
from mortarbench.harness.files.datafile import check_size, opened
from mortarbench.harness.files.durable import replacing

EXPECTED = "an npz file"
#: size of a cache line in bytes; misaligned arrays would affect measured times
ALIGNMENT = 64
#: number of bytes before the name and the extra field of a zip member
_LOCAL_HEADER = 30
_PADDING = b"\xfe\xca"  #: ID of an extra field, which readers skip
_ENCRYPTED = 1  #: flag of an encrypted member
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
#: kinds of dtypes that are read; records and objects, which are pickled, are refused
_KINDS = "biufcSU"
_MAX_NONE_BYTES = 512  #: number of bytes that suffice for a pickled None
_PIECE_BYTES = 2**20  #: number of bytes that are decompressed at a time


class _PickledError(ValueError):
    """Error for an array of Python objects, such as a SciPy matrix saved by NumPy.

    The argument is the beginning of the pickled data.
    """


def is_pickled_none(data: bytes) -> bool:
    """Return True if `data` are the pickled ``np.array(None)``; nothing is unpickled.

    NumPy writes protocol 4 or, before NumPy 2, protocol 3 with the former module names.
    """
    new, old = (pickle.dumps(np.array(None), protocol=i) for i in (4, 3))
    return data in (new, old, old.replace(b"numpy._core", b"numpy.core"))


def write_mappable(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays to a file that can be mapped.

    An existing file is replaced, not truncated: truncation would raise SIGBUS in any
    process that has mapped the file.
    """
    with replacing(path) as file, zipfile.ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            header = BytesIO()
            stored = np.ascontiguousarray(array).reshape(array.shape)
            npy.write_array_header_1_0(header, npy.header_data_from_array_1_0(stored))
            member = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            start = file.tell() + _LOCAL_HEADER + len(member.filename.encode()) + 4
            # NumPy pads the npy header to a multiple of 64 bytes
            padding = -start % ALIGNMENT
            member.extra = _PADDING + padding.to_bytes(2, "little") + bytes(padding)
            archive.writestr(member, header.getvalue() + stored.tobytes())


def mapped(path: Path, *, limited: bool = True) -> dict[str, NDArray[Any]]:
    """Map all arrays of a file into memory; assignments change only a private copy.

    limited : refuse a file larger than the limit of `harness.files.datafile`

    Raises
    ------
    InputError
        For the same reasons as in `harness.files.datafile.opened`.
    ValueError, BadZipFile
        If the file is not an npz file that can be mapped.

    """
    with opened(path, EXPECTED, limited=limited) as file:
        memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
        with zipfile.ZipFile(file) as archive:
            members = _members(archive)
        return {name: _array(memory, m) for name, m in members.items()}


def read(path: Path) -> dict[str, NDArray[Any]]:
    """Read all arrays of a file without unpickling; an array that is None is left out.

    Raises
    ------
    InputError
        For the same reasons as in `harness.files.datafile.opened`, if the arrays would
        exceed the memory limit, or if an array is pickled.
    ValueError, BadZipFile
        If the file is not an npz file of plain arrays.

    """
    with opened(path, EXPECTED) as file, zipfile.ZipFile(file) as archive:
        members = _members(archive)
        check_size(f"{path}: its content", sum(m.file_size for m in members.values()))
        arrays = {}
        for name, member in members.items():
            try:
                arrays[name] = _read_array(archive, member)
            except _PickledError as e:
                if is_pickled_none(e.args[0]):
                    continue
                raise InputError(
                    f"{path}: {shortened(name)} is a pickled Python object, which is "
                    "never read; expected an array of numbers (for a sparse matrix, "
                    "toarray(), or its parts P_data, P_indices, P_indptr, P_shape)"
                ) from None
        return arrays


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Check the members of an archive, and return them by the names of the arrays."""
    members: dict[str, zipfile.ZipInfo] = {}
    for member in archive.infolist():
        name = member.filename.removesuffix(".npy")
        if name == member.filename or name in members:
            raise ValueError(f"{shortened(name)!r} is not an array, or occurs twice")
        if member.flag_bits & _ENCRYPTED or member.compress_type not in _METHODS:
            raise ValueError(f"{shortened(name)!r}: encrypted or unknown compression")
        members[name] = member
    return members


def _array(memory: mmap.mmap, member: zipfile.ZipInfo) -> NDArray[Any]:
    """Check that a member is uncompressed and aligned, and return a view of its array.

    memory : the mapped archive
    """
    begin = member.header_offset
    header = memory[begin : begin + _LOCAL_HEADER]
    skip = int.from_bytes(header[26:28], "little") + int.from_bytes(
        header[28:30], "little"
    )
    begin += _LOCAL_HEADER + skip
    if member.compress_type != zipfile.ZIP_STORED or begin % ALIGNMENT:
        raise ValueError(f"{member.filename} cannot be mapped")
    start = BytesIO(memory[begin : min(begin + 4096, begin + member.file_size)])
    shape, fortran, dtype = _header(start)
    if fortran:
        raise ValueError(f"{member.filename} is not an array in C order")
    count = _count(shape, dtype, member.file_size - start.tell())
    if count == 0:
        return np.empty(shape, dtype)
    flat = np.frombuffer(memory, dtype, count, begin + start.tell())
    return flat.reshape(shape)


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    """Read the array of a member, but no more bytes than its header declares."""
    with archive.open(member) as file:
        shape, fortran, dtype = _header(file)
        count = _count(shape, dtype, member.file_size - file.tell())
        values = bytearray(count * dtype.itemsize)
        view, begin = memoryview(values), 0
        while begin < len(values):
            piece = file.read(min(_PIECE_BYTES, len(values) - begin))
            if not piece:
                raise ValueError(f"{member.filename} is truncated")
            view[begin : begin + len(piece)] = piece
            begin += len(piece)
        file.read(1)  # zipfile compares the checksum only at the end of the member
    if count == 0:
        return np.empty(shape, dtype)
    return np.frombuffer(values, dtype).reshape(shape, order="F" if fortran else "C")


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return shape, order (True for Fortran order) and dtype of an npy file."""
    readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    version = npy.read_magic(file)
    if version not in readers:
        raise ValueError(f"the npy header has version {version}; expected 1.0 or 2.0")
    shape, fortran, dtype = readers[version](file)
    if dtype.hasobject:
        raise _PickledError(file.read(_MAX_NONE_BYTES))
    if dtype.kind not in _KINDS or not dtype.itemsize:
        raise ValueError("not a plain array of numbers or text")
    return shape, fortran, dtype


def _count(shape: tuple[int, ...], dtype: np.dtype[Any], there: int) -> int:
    """Return the number of values of an array, checked against the available bytes.

    there : number of bytes in the file after the header
    """
    count = prod(shape)  # Python integers, unlike NumPy integers, do not overflow
    if min(shape, default=0) < 0 or count * dtype.itemsize > there:
        raise ValueError(
            f"the file has {there} bytes left; expected {count} values of {dtype}"
        )
    return count
