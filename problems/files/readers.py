"""QPs from files, ``file:PATH``, in the format that the suffix indicates."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csc_array, eye_array

from mortarbench.harness import QP, InputError, Vector
from mortarbench.harness.checked import is_number, located
from mortarbench.harness.files.datafile import content
from mortarbench.harness.files.matfile import read_mat
from mortarbench.harness.files.parquetfile import load_parquet
from mortarbench.harness.files.qpfile import (
    check_dense,
    load_qp,
    malformed,
    qp_of,
    stored_matrix,
)
from mortarbench.problems.files.file_digest import format_of
from mortarbench.problems.files.qps import parse_qps
from mortarbench.problems.files.two_sided import LoadedQP, TwoSidedQP, loaded

#: bound on the memory of the Python objects of a text file, relative to its size
_COPIES = 16


def read(path: Path, row: int | None = None) -> LoadedQP:
    """Read a QP in the format indicated by the suffix of its path, ignoring .gz.

    row : row of a Parquet file, counted from 1; None for the only row

    Raises
    ------
    InputError
        If the suffix is unknown, the file is damaged, or its QP is not convex.

    """
    suffix = format_of(path)
    if suffix == ".parquet":
        return _with_units(path, load_parquet(path, row))
    if row is not None:
        raise InputError(
            f"{path}#{row}: only Parquet files contain several problems; expected "
            f"{path}"
        )
    return _READERS[suffix](path)


def _npz(path: Path) -> LoadedQP:
    return _with_units(path, load_qp(path))


def _mat(path: Path) -> LoadedQP:
    """Read a .mat file: an export (it contains G or h) or a Maros-Mészáros problem."""
    arrays = read_mat(path)
    with malformed(path):
        if not {"G_data", "G", "h"} & arrays.keys():
            return loaded(maros_meszaros(arrays))
        # a file may contain further variables of a session
        exported = qp_of({"meta": np.array("{}"), **arrays})
    return _with_units(path, exported)


def _text(path: Path, expected: str, parse: Callable[[str], TwoSidedQP]) -> LoadedQP:
    """Read a text file.

    expected : description of the file, for messages
    parse : function that parses the text
    """
    data = content(path, expected, copies=_COPIES)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: not UTF-8; expected {expected}") from None
    with located(str(path)):
        return loaded(parse(text))


_qps = partial(_text, expected="a QPS file", parse=parse_qps)
_READERS: dict[str, Callable[[Path], LoadedQP]] = {
    ".npz": _npz,
    ".mat": _mat,
    ".qps": _qps,
    ".mps": _qps,
    ".sif": _qps,
}


def maros_meszaros(arrays: Mapping[str, Any]) -> TwoSidedQP:
    """Return the problem  ½xᵀPx + qᵀx + r,  l ≤ Ax ≤ u  from arrays of a .mat file.

    P and q may be named Q and c, l and u may be named rl and ru, and r may be missing.
    Bounds lb and ub of the variables may be missing. In the files of the collection,
    the last n rows of A are the identity; they are converted to bounds of variables.

    Raises
    ------
    InputError
        If a variable is missing, or its shape is inconsistent with that of another one.

    """
    read = partial(_first_named, arrays)
    P, q = read(matrix, "P", "Q"), read(vector, "q", "c")
    A, l, u = read(matrix, "A"), read(vector, "l", "rl"), read(vector, "u", "ru")
    r = float(vector(arrays, "r").sum()) if "r" in arrays else 0.0
    n, m = q.size, l.size
    lb = vector(arrays, "lb") if "lb" in arrays else np.full(n, -np.inf)
    ub = vector(arrays, "ub") if "ub" in arrays else np.full(n, np.inf)
    for name, got, right in (
        ("P", P.shape, (n, n)),
        ("A", A.shape, (m, n)),
        ("u", u.shape, (m,)),
        ("lb", lb.shape, (n,)),
        ("ub", ub.shape, (n,)),
    ):
        if got != right:
            raise InputError(f"{name} has shape {got}, expected {right}")
    for name, size in (("n", n), ("m", m)):
        if name in arrays and vector(arrays, name).tolist() != [size]:
            raise InputError(f"{name} contradicts the other variables; expected {size}")
    if not np.isfinite(r):
        raise InputError("r contains inf; expected a finite number")
    if m >= n and (A[m - n :] != eye_array(n, format="csc")).nnz == 0:
        lb, ub = np.maximum(lb, l[m - n :]), np.minimum(ub, u[m - n :])
        A, l, u = A[: m - n], l[: m - n], u[: m - n]
    return TwoSidedQP(P=P, q=q, r=r, A=A, l=l, u=u, lb=lb, ub=ub)


def _first_named(
    arrays: Mapping[str, Any], read: Callable[..., Any], *names: str
) -> Any:
    """Read the variable with the first of `names` that is present."""
    there = (n for n in names if n in arrays or f"{n}_data" in arrays)
    return read(arrays, next(there, names[0]))


def matrix(arrays: Mapping[str, Any], name: str) -> Any:
    """Return a variable as a sparse matrix; raise InputError if it is none."""
    M = stored_matrix(arrays, name)
    if M is None:
        raise InputError(f"{name} is missing; expected a matrix of numbers")
    return csc_array(M, dtype=float)


def vector(arrays: Mapping[str, Any], name: str) -> Vector:
    """Return a variable that is a row or column as a vector (n,)."""
    M = matrix(arrays, name)
    check_dense(name, M)
    if M.size and 1 not in M.shape:
        raise InputError(f"{name} is of shape {M.shape}; expected one row or column")
    return np.asarray(M.toarray().ravel())


def _with_units(path: Path, exported: tuple[QP, Mapping[str, Any]]) -> LoadedQP:
    """Return the QP of an export with the scale and the constant in its meta data."""
    qp, meta = exported
    scale, constant = meta.get("scale", 1.0), meta.get("constant", 0.0)
    if not all(
        is_number(v) and abs(v) <= sys.float_info.max for v in (scale, constant)
    ):
        raise InputError(f"{path}: meta: scale or constant is not a finite number")
    return LoadedQP(qp, float(scale), float(constant))
