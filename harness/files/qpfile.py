"""One QP in one npz file, without pickles, for workers and for other people's solvers.

::

    min ½xᵀPx + qᵀx   s.t.   Gx ≤ h,  Ax = b,  lb ≤ x ≤ ub

holds the vectors ``q, h, b, lb, ub``; each matrix M of ``P, G, A`` as the parts
``M_data, M_indices, M_indptr, M_shape`` of its compressed sparse columns (P whole, not
a triangle); and ``meta``, a JSON object. Absent constraints have zero rows, absent
bounds are ±inf. ``meta["dense"]`` lists the matrices that were dense. The structure of
a dual, where there is one, follows as matrices ``K, B`` and the vector ``fixed``.

What ``np.savez(path, P=P, q=q, G=G, h=h)`` writes is read, too: any matrix as a dense
array or in CSC parts, pairs ``G, h`` and ``A, b`` and bounds where there are any.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from math import prod
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array

from mortarbench.harness.errors import InputError, shortened, unknown
from mortarbench.harness.files.datafile import check_size, json_object
from mortarbench.harness.files.npz import write_mappable
from mortarbench.harness.files.store import digest_of, mapped_arrays
from mortarbench.harness.operators import Maker, SerialisableOperator, assembled
from mortarbench.harness.qp import (
    QP,
    Matrix,
    Structure,
    Vector,
    canonical,
    check_symmetric,
)

_VECTORS = ("q", "h", "b", "lb", "ub")
_MATRICES = ("P", "G", "A")
_STRUCTURE = ("K", "B")
_PARTS = ("data", "indices", "indptr", "shape")
_INGREDIENT = "P_from_"  #: of a P that is a serialised operator
_PLAIN = {*_VECTORS, *_MATRICES} | {f"{M}_{part}" for M in _MATRICES for part in _PARTS}


def explicit_matrices(qp: QP) -> tuple[dict[str, Matrix], list[str]]:
    """Return P, G and A, an operator P multiplied out, and the names of dense ones.

    Raises
    ------
    InputError
        When an operator P is too large for that, as `check_dense`.

    """
    P = qp.P
    if other := [type(one).__name__ for one in qp.sets[1:]]:
        raise InputError(f"no file holds sets of the kind {other[0]}; expected bounds")
    if not qp.is_explicit:
        n = qp.q.size
        check_size(f"P, an operator, as a dense matrix of {n} rows", 8 * n**2)
        P = assembled(P)
    matrices = {"P": P, "G": qp.G, "A": qp.A}
    return matrices, [name for name, M in matrices.items() if isinstance(M, np.ndarray)]


def save_qp(
    path: Path,
    qp: QP,
    meta: Mapping[str, Any] = MappingProxyType({}),
    *,
    serialised: bool = False,
) -> str:
    """Write `qp` to `path`; an operator P is multiplied out and counts as dense.

    Returns 16 hex digits that name its numbers: equal digests, equal QPs. An operator P
    that is serialised has another digest than the same one multiplied out.

    meta : plain data; its keys ``dense`` and ``maker`` are filled in here
    serialised : whether a P that is a `SerialisableOperator` is written as its arrays,
        which only we can read

    Raises
    ------
    InputError
        When the file cannot be written.

    """
    arrays, dense, maker = _parts(qp, serialised=serialised)
    digest = digest_of(arrays)
    arrays["meta"] = np.array(json.dumps({**meta, **maker, "dense": dense}))
    try:
        write_mappable(path, arrays)
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror}") from None
    return digest


def qp_digest(qp: QP, *, serialised: bool = False) -> str:
    """Name the numbers of a QP by 16 hex digits, as `save_qp` does."""
    return digest_of(_parts(qp, serialised=serialised)[0])


def _parts(
    qp: QP, *, serialised: bool
) -> tuple[dict[str, NDArray[Any]], list[str], dict[str, str]]:
    """Take a QP apart; also tell which matrices are dense, and who makes P."""
    P = qp.P
    if not (serialised and isinstance(P, SerialisableOperator)):
        return *_arrays(qp, structure=serialised), {}
    arrays, dense = _arrays(replace(qp, P=csc_array(P.shape)), structure=True)
    arrays |= {_INGREDIENT + name: array for name, array in P.arrays.items()}
    return arrays, dense, {"maker": P.maker}


def _arrays(qp: QP, *, structure: bool) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Take a QP apart; also tell which matrices are dense."""
    matrices, dense = explicit_matrices(qp)
    arrays = {name: getattr(qp, name) for name in _VECTORS}
    if structure and qp.structure is not None:
        matrices |= {name: getattr(qp.structure, name) for name in _STRUCTURE}
        arrays["fixed"] = qp.structure.fixed
    for name, M in matrices.items():
        M = csc_array(M)
        parts = (M.data, M.indices, M.indptr, np.array(M.shape))
        arrays |= {f"{name}_{part}": a for part, a in zip(_PARTS, parts, strict=True)}
    return arrays, dense


def load_qp(
    path: Path, *, operators: Mapping[str, Maker] | None = None
) -> tuple[QP, dict[str, Any]]:
    """Read a QP and its meta data.

    operators : makers of operators (`harness.operators`), for a file that the case
        worker of this very run wrote: it may hold an operator, and is as large as it
        is. Without them the file may be anybody's: an operator is refused, and so is
        what exceeds the limit of `harness.files.datafile`, or has no symmetric P

    Raises
    ------
    InputError
        When the file is no npz, lacks an array, or what it holds is no QP.

    """
    parts = tuple(f"{name}_{part}" for name in _MATRICES for part in _PARTS)
    own = operators is not None
    arrays = mapped_arrays(path, limited=not own)
    lacking = [name for name in (*_VECTORS, *parts, "meta") if name not in arrays]
    if lacking and not own and "meta" not in arrays:
        return _plain_qp(path, arrays), {}
    if lacking:
        raise InputError(f"{path}: {', '.join(lacking)} missing")
    try:
        array = arrays["meta"]
        if array.dtype.kind != "U" or array.size != 1:
            raise ValueError("meta is no text")
        meta = json_object(str(array.item()))
        vectors: dict[str, Any] = {name: _vector(arrays, name) for name in _VECTORS}
        matrices = {name: _matrix(arrays, name) for name in _MATRICES}
        dense = listed_dense(meta)
        if not own:
            _check_foreign(matrices, dense, meta)
        structure = _structure(arrays) if "fixed" in arrays else None
        for name in dense:
            # the values of a full one are viewed, not copied
            M = matrices[name]
            rows, columns = M.shape
            full = M.nnz == rows * columns and M.has_canonical_format
            matrices[name] = M.data.reshape(columns, rows).T if full else M.toarray()
        if operators is not None and "maker" in meta:
            n, maker = vectors["q"].size, str(meta["maker"])
            matrices["P"] = SerialisableOperator(
                n, maker, _ingredients(arrays), operators
            )
        qp = QP(**vectors, **matrices, structure=structure)
        if not own:
            check_symmetric(qp.P)
    except (ValueError, TypeError, OverflowError) as e:
        raise InputError(f"{path}: {shortened(' '.join(str(e).split()))}") from None
    except InputError as e:
        raise InputError(f"{path}: {e}") from None
    return qp, meta


def _plain_qp(path: Path, arrays: Mapping[str, NDArray[Any]]) -> QP:
    """Make a QP of the arrays that somebody saved under their names."""
    try:
        for name in arrays:
            if name not in _PLAIN:
                raise unknown("array", name, (*_VECTORS, *_MATRICES))
        matrices = {name: _plain_matrix(arrays, name) for name in _MATRICES}
        vectors = {name: _plain_vector(arrays, name) for name in _VECTORS}
        arguments: dict[str, Any] = {**matrices, **vectors}
        qp = QP.from_arrays(**arguments)
    except (ValueError, TypeError, OverflowError) as e:
        raise InputError(f"{path}: {shortened(' '.join(str(e).split()))}") from None
    except InputError as e:
        raise InputError(f"{path}: {e}") from None
    return qp


def _plain_matrix(arrays: Mapping[str, NDArray[Any]], name: str) -> Matrix | None:
    if name not in arrays:
        parts = [f"{name}_{part}" for part in _PARTS]
        there = [part for part in parts if part in arrays]
        if there and len(there) < len(parts):
            lacking = ", ".join(part for part in parts if part not in arrays)
            raise ValueError(f"{lacking} missing beside {there[0]}")
        return _matrix(arrays, name) if there else None
    M = _vector(arrays, name)
    if M.ndim != 2:
        raise ValueError(f"{name} has shape {M.shape}; expected two dimensions")
    if not np.isfinite(M).all():
        raise ValueError(f"{name} holds NaN or inf; expected finite numbers")
    return M


def _plain_vector(arrays: Mapping[str, NDArray[Any]], name: str) -> Vector | None:
    """Take a vector, also one that is saved as a matrix of one row or column."""
    if name not in arrays:
        return None
    v = _vector(arrays, name)
    return v.ravel() if v.ndim == 2 and 1 in v.shape else v


def listed_dense(meta: Mapping[str, Any]) -> set[str]:
    """Take the names of dense matrices from meta data.

    Raises
    ------
    ValueError
        When they are no list of texts.

    """
    names = meta.get("dense", [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError("meta: dense is no list of names")
    return set(_MATRICES).intersection(names)


def check_dense(name: str, M: Matrix) -> None:
    """Refuse a matrix that would be too large if it were dense.

    Raises
    ------
    InputError
        As `harness.files.datafile.check_size`.

    """
    check_size(f"{name}, dense and {M.shape[0]} × {M.shape[1]},", 8 * prod(M.shape))


def _check_foreign(
    matrices: Mapping[str, Matrix], dense: set[str], meta: Mapping[str, Any]
) -> None:
    """Refuse what only our own runs write, and what would be too large."""
    if "maker" in meta:
        raise ValueError(
            "holds P as an operator, which is read only where the run itself wrote it; "
            "expected P as a matrix, as export writes it"
        )
    for name in dense:
        check_dense(name, matrices[name])


def _structure(arrays: Mapping[str, NDArray[Any]]) -> Structure:
    parts = [f"{name}_{part}" for name in _STRUCTURE for part in _PARTS]
    if missing := [name for name in parts if name not in arrays]:
        raise ValueError(f"{', '.join(missing)} missing beside fixed")
    if arrays["fixed"].dtype.kind not in "iu":
        raise ValueError("fixed must hold integers")
    fixed = arrays["fixed"].astype(np.int64, casting="same_kind")
    K, B = _matrix(arrays, "K"), _matrix(arrays, "B")
    N = K.shape[0]
    if K.shape != (N, N) or B.shape != (arrays["q"].size, N) or fixed.ndim != 1:
        raise ValueError("K, B and fixed do not fit each other, or q")
    if ((fixed < 0) | (fixed >= N)).any():
        raise ValueError(f"fixed holds indices out of range; expected 0 … {N - 1}")
    return Structure(K=K, B=B, fixed=fixed)


def _ingredients(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {
        name.removeprefix(_INGREDIENT): array
        for name, array in arrays.items()
        if name.startswith(_INGREDIENT)
    }


def _vector(arrays: Mapping[str, NDArray[Any]], name: str) -> Vector:
    if arrays[name].dtype.kind not in "iuf":
        raise ValueError(f"{name} is of type {arrays[name].dtype}; expected numbers")
    with np.errstate(over="ignore"):  # beyond double precision is inf, which is judged
        return arrays[name].astype(float, copy=False)


def _matrix(arrays: Mapping[str, NDArray[Any]], name: str) -> Matrix:
    """Put a matrix together; unchecked, an index out of range crashes a product."""
    data = _vector(arrays, f"{name}_data")
    if not np.isfinite(data).all():
        raise ValueError(f"{name}_data holds NaN or inf; expected finite numbers")
    indices, indptr, shape = (arrays[f"{name}_{part}"] for part in _PARTS[1:])
    if {indices.dtype.kind, indptr.dtype.kind, shape.dtype.kind} - set("iu"):
        raise ValueError(f"{name}_indices, _indptr and _shape must hold integers")
    try:
        return compressed(data, indices, indptr, tuple(shape.tolist()))
    except (ValueError, TypeError, OverflowError) as e:
        raise ValueError(f"{name} is no matrix in CSC parts: {e}") from None


def compressed(
    data: NDArray[Any], indices: NDArray[Any], indptr: NDArray[Any], shape: Any
) -> Matrix:
    """Make a matrix of its compressed columns; a wrong index would crash a product.

    Raises
    ------
    ValueError, TypeError, OverflowError
        When they fit neither each other nor `shape`.

    """
    if (
        indptr[1:] < indptr[:-1]
    ).any():  # scipy (1.17.1) looks at differences: overflow
        raise ValueError("indptr decreases")
    M = csc_array((data, indices, indptr), shape=shape)
    M.check_format(full_check=True)
    return canonical(M)
