"""QPs from files, ``file:PATH``: exports, Maros-Mészáros .mat files, QPS, Parquet."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import eye_array

from mortarbench.harness import QP, InputError
from mortarbench.harness.checked import is_number, located
from mortarbench.harness.files.datafile import content
from mortarbench.harness.files.matfile import matrix, read_mat, to_qp, vector
from mortarbench.harness.files.parquetfile import load_parquet
from mortarbench.harness.files.qpfile import load_qp
from mortarbench.harness.qp import check_convex
from mortarbench.problems.files.file_digest import format_of
from mortarbench.problems.files.qps import parse_qps
from mortarbench.problems.files.two_sided import TwoSidedQP, one_sided

#: QP, scale and constant: the objective of the file is scale·(objective of the QP) +
#: constant
Loaded = tuple[QP, float, float]

#: bound on the memory of the Python objects of a QPS file, relative to the file size
_COPIES = 16


def read(path: Path) -> Loaded:
    """Read a QP in the format indicated by the suffix of its path, ignoring .gz.

    Raises
    ------
    InputError
        If the suffix is unknown, the file is damaged, or its QP is not convex.

    """
    qp, scale, constant = _READERS[format_of(path)](path)
    with located(str(path)):
        check_convex(qp.P)
    return qp, scale, constant


def _npz(path: Path) -> Loaded:
    qp, meta = load_qp(path)
    with located(str(path)):
        return _with_units(qp, meta)


def _mat(path: Path) -> Loaded:
    """Read a .mat file: an export (it contains G or h) or a Maros-Mészáros problem."""
    arrays = read_mat(path)
    with located(str(path)):
        if {"G", "h"} & arrays.keys():
            return _with_units(*to_qp(arrays))
        two_sided = maros_meszaros(arrays)
        return one_sided(two_sided), 1.0, two_sided.r


def _parquet(path: Path) -> Loaded:
    qp, meta = load_parquet(path)
    with located(str(path)):
        return _with_units(qp, meta)


def _qps(path: Path) -> Loaded:
    data = content(path, "a QPS file", copies=_COPIES)
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path}: not UTF-8; expected a QPS file") from None
    with located(str(path)):
        two_sided, sign = parse_qps(text)
        return one_sided(two_sided), sign, sign * two_sided.r


_READERS: dict[str, Callable[[Path], Loaded]] = {
    ".npz": _npz,
    ".mat": _mat,
    ".parquet": _parquet,
    ".qps": _qps,
    ".mps": _qps,
    ".sif": _qps,
}


def maros_meszaros(arrays: Mapping[str, Any]) -> TwoSidedQP:
    """Return the problem  ½xᵀPx + qᵀx + r,  l ≤ Ax ≤ u  from arrays of a .mat file.

    P and q may be named Q and c, and r may be missing. In the files of the collection,
    the last n rows of A are the identity; they are converted to bounds of variables.

    Raises
    ------
    InputError
        If a variable is missing, its shape is inconsistent with that of another one, or
        P, A, q or r contains a number that is not finite.

    """
    read = partial(_first_named, arrays)
    P, q = read(matrix, "P", "Q"), read(vector, "q", "c")
    A, l, u = read(matrix, "A"), read(vector, "l"), read(vector, "u")
    r = float(vector(arrays, "r").sum()) if "r" in arrays else 0.0
    if not all(np.isfinite(values).all() for values in (P.data, A.data, q, r)):
        raise InputError("P, A, q or r contains inf; expected finite numbers")
    n, m = q.size, l.size
    for name, got, right in (
        ("P", P.shape, (n, n)),
        ("A", A.shape, (m, n)),
        ("u", u.shape, (m,)),
    ):
        if got != right:
            raise InputError(f"{name} has shape {got}, expected {right}")
    for name, size in (("n", n), ("m", m)):
        if name in arrays and vector(arrays, name).tolist() != [size]:
            raise InputError(f"{name} contradicts the other variables; expected {size}")
    bounded = m >= n and (A[m - n :] != eye_array(n, format="csc")).nnz == 0
    rows = m - n if bounded else m
    return TwoSidedQP(
        P=P,
        q=q,
        r=r,
        A=A[:rows],
        l=l[:rows],
        u=u[:rows],
        lb=l[rows:] if bounded else np.full(n, -np.inf),
        ub=u[rows:] if bounded else np.full(n, np.inf),
    )


def _first_named(
    arrays: Mapping[str, Any], read: Callable[..., Any], *names: str
) -> Any:
    """Read the variable with the first of `names` that is present."""
    return read(arrays, next((name for name in names if name in arrays), names[0]))


def _with_units(qp: QP, meta: Mapping[str, Any]) -> Loaded:
    scale, constant = meta.get("scale", 1.0), meta.get("constant", 0.0)
    if not all(
        is_number(v) and abs(v) <= sys.float_info.max for v in (scale, constant)
    ):
        raise InputError("meta: scale or constant is not a finite number")
    return qp, float(scale), float(constant)
