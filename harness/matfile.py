"""One QP in one .mat file, for MATLAB and Octave; names as in `harness.qpfile`.

Vectors ``q, h, b, lb, ub`` are columns, matrices ``P, G, A`` sparse, ``meta`` is a JSON
text. Next to them lie what a case offers of its own, e.g. F, d, B, c, R of the paper.
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
from scipy.io import loadmat, savemat
from scipy.sparse import csc_array, issparse

from harness.datafile import check_size, json_object, opened, parsing
from harness.errors import InputError, shortened
from harness.qp import QP, Matrix, Vector
from harness.qpfile import (
    check_dense,
    check_symmetric,
    explicit_matrices,
    listed_dense,
)

_EXPECTED = "a .mat file"
_WRONG = "not a .mat file; expected one saved with -v7 or older"
_HEADER, _TAG = 128, 8  #: bytes of a version 5 file, and of each element
_COMPRESSED, _MATRIX = 15, 14  #: kinds of elements
_CLASSES = frozenset(range(4, 16))  #: text, sparse matrices, numbers of every type
_COPIES = 8  #: of a file that its parser may hold

_VECTORS = ("q", "h", "b", "lb", "ub")
_MATRICES = ("P", "G", "A")


def save_mat(
    path: Path, qp: QP, meta: Mapping[str, Any], more: Mapping[str, Any]
) -> None:
    """Write `qp` and the arrays `more` to `path`; `meta` is as in `save_qp`.

    Raises
    ------
    InputError
        When the file cannot be written.

    """
    matrices, dense = explicit_matrices(qp)
    arrays = {name: M.tocsc() if issparse(M) else M for name, M in more.items()}
    arrays |= {name: getattr(qp, name) for name in _VECTORS}
    arrays |= {name: csc_array(M) for name, M in matrices.items()}
    arrays["meta"] = json.dumps({**meta, "dense": dense})
    try:
        with path.open("wb") as file:  # given a name, savemat would append .mat to it
            savemat(file, arrays, do_compression=True, oned_as="column")
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror}") from None


def read_mat(path: Path) -> dict[str, Any]:
    """Read every variable of a .mat file that is numbers or a text.

    Raises
    ------
    InputError
        When it cannot be read, is no .mat file of MATLAB 4 to 7.2, or declares more
        than `harness.datafile` allows.

    """
    with opened(path, _EXPECTED) as file:
        data = file.read()
    if b"MATLAB 7.3" in data[:_HEADER] or data.startswith(b"\x89HDF"):
        raise InputError(f"{path}: a .mat file of version 7.3; save it with -v7")
    with parsing(path, _WRONG, _COPIES * len(data)):
        is_4 = 0 in data[:4]  # version 4 has no head, and nothing is compressed
        size = len(data) if is_4 else sum(map(_declared, _elements(data)))
        check_size(f"{path}: what it holds", size)
    with parsing(path, _WRONG, _COPIES * (len(data) + size)):
        plain = data if is_4 else _expanded(data)
        return dict(loadmat(BytesIO(plain), spmatrix=False))


class _Element(NamedTuple):
    """What a file of version 5 is made of, after its head."""

    order: str  #: of bytes, as struct has it
    kind: int
    body: bytes


def _elements(data: bytes) -> Iterator[_Element]:
    """List the elements of a version 5 file."""
    order = "<" if data[_HEADER - 2 : _HEADER] == b"IM" else ">"
    at = _HEADER
    while at < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        begin, at = at + _TAG, at + _TAG + size
        if at > len(data):
            raise ValueError("truncated")
        yield _Element(order, kind, data[begin:at])


def _declared(element: _Element) -> int:
    """Tell how many bytes an element has, or will have; its head says so."""
    if element.kind != _COMPRESSED:
        return len(element.body)
    head = zlib.decompressobj().decompress(element.body, _TAG)
    return int(struct.unpack(f"{element.order}II", head)[1])


def _expanded(data: bytes) -> bytes:
    """Decompress every element, and not a byte beyond what its head declares.

    Variables that are neither numbers nor text (cells, structures, objects) are left
    out: none of ours, and nested without bound.
    """
    parts = [data[:_HEADER]]
    for element in _elements(data):
        plain = _decompressed(element) if element.kind == _COMPRESSED else element
        head = f"{plain.order}II"
        if plain.kind != _MATRIX:
            raise ValueError("an element that is no variable")
        (flags,) = struct.unpack_from(f"{plain.order}I", plain.body, _TAG)
        if flags & 0xFF in _CLASSES:
            parts += [struct.pack(head, plain.kind, len(plain.body)), plain.body]
    return b"".join(parts)


def _decompressed(element: _Element) -> _Element:
    inflate = zlib.decompressobj()
    head = inflate.decompress(element.body, _TAG)
    kind, size = struct.unpack(f"{element.order}II", head)
    body = inflate.decompress(inflate.unconsumed_tail, size) if size else b""
    if len(body) < size or inflate.decompress(inflate.unconsumed_tail, 1):
        raise ValueError("a compressed variable has not the size that it declares")
    return _Element(element.order, kind, body)


def to_qp(arrays: Mapping[str, Any]) -> tuple[QP, dict[str, Any]]:
    """Make of the variables that `save_mat` wrote the QP and its meta data.

    Raises
    ------
    InputError
        When one is missing, of the wrong kind, or they make no QP.

    """
    vectors: dict[str, Any] = {name: vector(arrays, name) for name in _VECTORS}
    matrices = {name: matrix(arrays, name) for name in _MATRICES}
    try:
        text = np.asarray(arrays.get("meta", "{}"))
        if text.dtype.kind != "U" or text.size != 1:
            raise ValueError("meta is no text")
        meta = json_object(str(text.item()))
        for name in _MATRICES:
            if not np.isfinite(matrices[name].data).all():
                raise ValueError(f"{name} holds inf; expected finite numbers")
        for name in listed_dense(meta):
            check_dense(name, matrices[name])
            matrices[name] = matrices[name].toarray()
        qp = QP(**vectors, **matrices)
        check_symmetric(qp.P)
    except (ValueError, TypeError, OverflowError) as e:
        raise InputError(shortened(" ".join(str(e).split()))) from None
    return qp, meta


def vector(arrays: Mapping[str, Any], name: str) -> Vector:
    """Take the numbers of a row, a column or a sparse one, (n,)."""
    M = matrix(arrays, name)
    if M.size and 1 not in M.shape:
        raise InputError(f"{name} is of shape {M.shape}; expected one row or column")
    check_dense(name, M)
    flat: Vector = M.toarray().ravel()
    return flat


def matrix(arrays: Mapping[str, Any], name: str) -> Matrix:
    """Take a matrix of numbers, dense or sparse, as csc."""
    if name not in arrays:
        raise InputError(f"{name} is missing")
    if np.dtype(getattr(arrays[name], "dtype", object)).kind not in "iufb":
        raise InputError(f"{name} is no matrix of numbers")
    given = arrays[name]
    if given.ndim > 2:
        raise InputError(f"{name} has {given.ndim} dimensions; expected at most two")
    check_size(f"{name}, {max(given.shape, default=1)} wide or high,",
               8 * max(given.shape, default=1))  # fmt: skip
    try:
        with np.errstate(over="ignore"):
            M = csc_array(given, dtype=float)
        M.check_format(full_check=True)  # scipy does not, where it reads a file
    except (ValueError, TypeError, OverflowError, IndexError) as e:
        raise InputError(f"{name} is no matrix: {shortened(str(e))}") from None
    if np.isnan(M.data).any():
        raise InputError(f"{name} holds NaN; expected numbers")
    return M
