"""One QP in one .mat file, for MATLAB and Octave.

The variables have the same names as in `harness.files.qpfile`. The vectors ``q, h, b,
lb, ub`` are columns, the matrices ``P, G, A`` are sparse, and ``meta`` is a JSON text.
Indices of sets, such as ``disc_index``, start at 0. A case may add further arrays, for
instance the arrays F, d, B, c and R of the paper's dual QP.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat, savemat
from scipy.sparse import csc_array, issparse

from mortarbench.harness.errors import InputError, shortened
from mortarbench.harness.files.datafile import check_size, content, json_object, parsing
from mortarbench.harness.files.durable import replacing
from mortarbench.harness.files.qpfile import (
    check_dense,
    compressed,
    explicit_matrices,
    listed_dense,
)
from mortarbench.harness.qp import QP, Matrix, Vector, canonical
from mortarbench.harness.sets.arrays import further_sets, set_arrays

_EXPECTED = "a .mat file"
_WRONG = "not a .mat file; expected a file saved with -v7 or older"
#: sizes in bytes of the header of a version 5 file, and of the tag before each element
_HEADER, _TAG = 128, 8
_COMPRESSED, _MATRIX, _UTF_8 = 15, 14, 16  #: codes of data types
_TYPES = {  #: NumPy types of numbers by code of the data type
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
    17: "u2",
    18: "u4",
}
_TEXT, _SPARSE = 4, 5  #: codes of the classes of variables
#: codes of the classes that are read: texts, sparse matrices and all numeric arrays
_CLASSES = frozenset((_TEXT, _SPARSE, *range(6, 16)))
_COMPLEX = 0x800  #: flag of complex variables
_COPIES = 8  #: memory limit of a parser, in multiples of the size of the content

_VECTORS = ("q", "h", "b", "lb", "ub")
_MATRICES = ("P", "G", "A")


def save_mat(
    path: Path, qp: QP, meta: Mapping[str, Any], more: Mapping[str, Any]
) -> None:
    """Write `qp` and the arrays `more` to `path`; `meta` is as in `save_qp`.

    more : further arrays by name; the operator P of `qp` may be among them

    Raises
    ------
    InputError
        If the file cannot be written, or P is an operator that is too large to be
        assembled.

    """
    matrices, dense = explicit_matrices(qp)
    more = {name: matrices["P"] if M is qp.P else M for name, M in more.items()}
    arrays = {name: M.tocsc() if issparse(M) else M for name, M in more.items()}
    arrays |= {name: getattr(qp, name) for name in _VECTORS}
    arrays |= set_arrays(qp.sets[1:])
    arrays |= {name: csc_array(M) for name, M in matrices.items()}
    arrays["meta"] = json.dumps({**meta, "dense": dense})
    try:
        with replacing(path) as file:
            savemat(file, arrays, do_compression=True, oned_as="column")
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror}") from None


def read_mat(path: Path) -> dict[str, Any]:
    """Return the variables of a .mat file by name; None for unsupported types.

    Raises
    ------
    InputError
        If the file cannot be read, is not a .mat file of MATLAB 4 to 7.2, or declares
        more data than `harness.files.datafile` allows.

    """
    data = content(path, _EXPECTED)
    if b"MATLAB 7.3" in data[:_HEADER] or data.startswith(b"\x89HDF"):
        raise InputError(f"{path}: a .mat file of version 7.3; save it with -v7")
    with parsing(path, _WRONG, _COPIES * len(data)):
        if 0 in data[:4]:  # the file has version 4, which has no compression
            return dict(loadmat(BytesIO(data), spmatrix=False))
        elements = list(_elements(data))
        size = sum(map(_declared, elements))
        check_size(f"{path}: its content", size)
    with parsing(path, _WRONG, _COPIES * size):
        variables: dict[str, Any] = {}
        for element in elements:
            name, value = _variable(element)
            if name in variables:
                raise ValueError(f"{name} occurs twice")
            variables[name] = value
        return variables


class _Element(NamedTuple):
    """Data element of a version 5 file."""

    order: str  #: byte order, in the notation of struct and NumPy
    kind: int  #: code of the data type
    body: bytes  #: content of the element without the tag


def _elements(data: bytes) -> Iterator[_Element]:
    """Yield the elements of a version 5 file."""
    order = {b"IM": "<", b"MI": ">"}[data[_HEADER - 2 : _HEADER]]
    at = _HEADER
    while at < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        begin, at = at + _TAG, at + _TAG + size
        if at > len(data):
            raise ValueError("truncated")
        yield _Element(order, kind, data[begin:at])


def _declared(element: _Element) -> int:
    """Return the declared size of an element after decompression, in bytes."""
    if element.kind != _COMPRESSED:
        return len(element.body)
    head = zlib.decompressobj().decompress(element.body, _TAG)
    return int(struct.unpack(f"{element.order}II", head)[1])


def _decompressed(element: _Element) -> _Element:
    """Decompress an element, and check that it has its declared size."""
    inflate = zlib.decompressobj()
    head = inflate.decompress(element.body, _TAG)
    kind, size = struct.unpack(f"{element.order}II", head)
    body = inflate.decompress(inflate.unconsumed_tail, size) if size else b""
    if len(body) < size or inflate.decompress(inflate.unconsumed_tail, 1):
        raise ValueError(
            "the size of a compressed variable differs from its declared size"
        )
    return _Element(element.order, kind, body)


def _variable(element: _Element) -> tuple[str, Any]:
    """Return the name and the value of a variable.

    The value is a text, an array or a sparse matrix, or None if the type is not
    supported. SciPy's reader is not used for version 5 files, since it crashes on some
    damaged files (SciPy 1.17.1).
    """
    if element.kind == _COMPRESSED:
        element = _decompressed(element)
    if element.kind != _MATRIX:
        raise ValueError("the file has an element that is not a variable")
    parts = _parts(element)
    flags, shape = int(next(parts)[0]), tuple(map(int, next(parts)))
    name = next(parts).tobytes().decode("latin-1")
    kind = flags & 0xFF
    if kind not in _CLASSES or flags & _COMPLEX:
        return name, None
    if min(shape) < 0:
        raise ValueError(f"{name} is of shape {shape}")
    if kind == _SPARSE:
        rows, starts, values = (next(parts) for _ in range(3))
        count = starts[-1]  # MATLAB may allocate more entries than it uses
        return name, compressed(values[:count], rows[:count], starts, shape)
    values = next(parts)
    if kind == _TEXT:
        return name, np.array("".join(map(chr, values.tolist())))
    return name, values.reshape(shape, order="F")


def _parts(element: _Element) -> Iterator[NDArray[Any]]:
    """Yield the numeric arrays that encode a variable: flags, shape, name, values."""
    order, _, body = element
    at = 0
    while at < len(body):
        (kind,) = struct.unpack_from(f"{order}I", body, at)
        if kind >> 16:  # a short element, whose data of up to four bytes are in the tag
            kind, size, begin = kind & 0xFFFF, kind >> 16, at + 4
            at += _TAG
        else:
            (size,) = struct.unpack_from(f"{order}I", body, at + 4)
            begin, at = at + _TAG, at + _TAG + size + -size % _TAG
        if begin + size > len(body):
            raise ValueError("truncated")
        if kind == _UTF_8:
            text = body[begin : begin + size].decode("utf-8")
            yield np.array([ord(letter) for letter in text], dtype=np.uint32)
        else:
            yield np.frombuffer(body[begin : begin + size], order + _TYPES[kind])


def to_qp(arrays: Mapping[str, Any]) -> tuple[QP, dict[str, Any]]:
    """Return the QP and the meta data from variables as written by `save_mat`.

    Raises
    ------
    InputError
        If a variable is missing or has the wrong type, or the variables do not define a
        valid QP.

    """
    parts: dict[str, Any] = {name: vector(arrays, name) for name in _VECTORS}
    parts |= {name: matrix(arrays, name) for name in _MATRICES}
    try:
        text = np.asarray(arrays.get("meta", "{}"))
        if text.dtype.kind != "U" or text.size != 1:
            raise ValueError("meta is not a string")
        meta = json_object(str(text.item()))
        for name in listed_dense(meta):
            check_dense(name, parts[name])
            parts[name] = parts[name].toarray()
        return QP.from_arrays(**parts, sets=further_sets(arrays)), meta
    except (ValueError, TypeError, OverflowError) as e:
        raise InputError(shortened(" ".join(str(e).split()))) from None


def vector(arrays: Mapping[str, Any], name: str) -> Vector:
    """Check that a variable is a row or column, and return it as a vector (n,)."""
    M = matrix(arrays, name)
    if M.size and 1 not in M.shape:
        raise InputError(f"{name} is of shape {M.shape}; expected one row or column")
    check_dense(name, M)
    flat: Vector = M.toarray().ravel()
    return flat


def matrix(arrays: Mapping[str, Any], name: str) -> Matrix:
    """Check that a variable is a matrix of numbers, and return it in CSC format."""
    if name not in arrays:
        raise InputError(f"{name} is missing")
    if getattr(arrays[name], "dtype", np.dtype(object)).kind not in "iufb":
        raise InputError(f"{name} is not a matrix of numbers")
    array = arrays[name]
    if array.ndim > 2:
        raise InputError(f"{name} has {array.ndim} dimensions; expected at most two")
    check_size(
        f"{name}, {max(array.shape, default=1)} rows or columns,",
        8 * max(array.shape, default=1),
    )
    try:
        with np.errstate(over="ignore"):
            M = csc_array(array, dtype=float)
    except (ValueError, TypeError, OverflowError, IndexError) as e:
        raise InputError(f"{name} is not a matrix: {shortened(str(e))}") from None
    M = canonical(M)
    if np.isnan(M.data).any():
        raise InputError(f"{name} contains NaN; expected numbers")
    return M
