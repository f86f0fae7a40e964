"""One QP in one npz file, without pickles, for workers and for other people's solvers.

::

    min ½xᵀPx + qᵀx   s.t.   Gx ≤ h,  Ax = b,  lb ≤ x ≤ ub

holds the vectors ``q, h, b, lb, ub``; each matrix M of ``P, G, A`` as the parts
``M_data, M_indices, M_indptr, M_shape`` of its compressed sparse columns (P whole, not
a triangle); and ``meta``, a JSON object. Absent constraints have zero rows, absent
bounds are ±inf. ``meta["dense"]`` lists the matrices that were dense. The structure of
a dual, where there is one, follows as matrices ``K, B`` and the vector ``fixed``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array

from harness.errors import InputError
from harness.npz import write_mappable
from harness.qp import QP, Matrix, Structure, Vector
from harness.recipe import Recipe
from harness.store import digest_of, mapped_arrays

_VECTORS = ("q", "h", "b", "lb", "ub")
_MATRICES = ("P", "G", "A")
_STRUCTURE = ("K", "B")
_PARTS = ("data", "indices", "indptr", "shape")
_INGREDIENT = "P_from_"  #: of a P that is a recipe


def explicit_matrices(qp: QP) -> tuple[dict[str, Matrix], list[str]]:
    """Return P, G and A, an operator P multiplied out, and the names of dense ones."""
    P = qp.P if qp.is_explicit else qp.P @ np.eye(qp.q.size)
    matrices = {"P": P, "G": qp.G, "A": qp.A}
    return matrices, [name for name, M in matrices.items() if isinstance(M, np.ndarray)]


def save_qp(
    path: Path, qp: QP, meta: Mapping[str, Any], *, recipe: bool = False
) -> str:
    """Write `qp` to `path`; an operator P is multiplied out and counts as dense.

    Returns 16 hex digits that name its numbers: equal digests, equal QPs. A P that is
    written as a recipe has another digest than the same one multiplied out.

    meta : plain data; its keys ``dense`` and ``maker`` are filled in here
    recipe : whether a P that is a `Recipe` is written as such, which only we can read

    Raises
    ------
    InputError
        When the file cannot be written.

    """
    arrays, dense, maker = _parts(qp, recipe=recipe)
    digest = digest_of(arrays)
    arrays["meta"] = np.array(json.dumps({**meta, **maker, "dense": dense}))
    try:
        write_mappable(path, arrays)
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror}") from None
    return digest


def qp_digest(qp: QP, *, recipe: bool = False) -> str:
    """Name the numbers of a QP by 16 hex digits, as `save_qp` does."""
    return digest_of(_parts(qp, recipe=recipe)[0])


def _parts(
    qp: QP, *, recipe: bool
) -> tuple[dict[str, NDArray[Any]], list[str], dict[str, str]]:
    """Take a QP apart; also tell which matrices are dense, and who makes P."""
    P = qp.P
    if not (recipe and isinstance(P, Recipe)):
        return *_arrays(qp, structure=recipe), {}
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


def load_qp(path: Path) -> tuple[QP, dict[str, Any]]:
    """Read a QP and its meta data.

    Raises
    ------
    InputError
        When the file is no npz, lacks an array, or what it holds is no QP.

    """
    parts = tuple(f"{name}_{part}" for name in _MATRICES for part in _PARTS)
    arrays = mapped_arrays(path, (*_VECTORS, *parts, "meta"))
    try:
        meta = json.loads(str(arrays["meta"]))
        if not isinstance(meta, dict):
            raise ValueError("meta is no JSON object")
        vectors = {name: _vector(arrays, name) for name in _VECTORS}
        matrices = {name: _matrix(arrays, name) for name in _MATRICES}
        structure = _structure(arrays) if "fixed" in arrays else None
        for name in set(_MATRICES).intersection(meta.get("dense", ())):
            matrices[name] = _dense(matrices[name])
        if "maker" in meta:
            matrices["P"] = _recipe(meta["maker"], arrays, vectors["q"].size)
        return QP(**vectors, **matrices, structure=structure), meta
    except (ValueError, TypeError) as e:
        raise InputError(f"{path}: {' '.join(str(e).split())}") from None


def _structure(arrays: Mapping[str, NDArray[Any]]) -> Structure:
    parts = [f"{name}_{part}" for name in _STRUCTURE for part in _PARTS]
    if missing := [name for name in parts if name not in arrays]:
        raise ValueError(f"{', '.join(missing)} missing beside fixed")
    fixed = arrays["fixed"].astype(np.int64, casting="safe")
    return Structure(K=_matrix(arrays, "K"), B=_matrix(arrays, "B"), fixed=fixed)


def _recipe(maker: str, arrays: Mapping[str, NDArray[Any]], n: int) -> Recipe:
    ingredients = {
        name.removeprefix(_INGREDIENT): array
        for name, array in arrays.items()
        if name.startswith(_INGREDIENT)
    }
    return Recipe(n, maker, ingredients)


def _vector(arrays: Mapping[str, NDArray[Any]], name: str) -> Vector:
    if arrays[name].dtype.kind not in "iuf":
        raise ValueError(f"{name} is of type {arrays[name].dtype}; expected numbers")
    return arrays[name].astype(float, copy=False)


def _dense(M: Any) -> Matrix:
    """Make a dense matrix; the values of a full one are viewed, not copied."""
    rows, columns = M.shape
    full = M.nnz == rows * columns and M.has_canonical_format
    return M.data.reshape(columns, rows).T if full else M.toarray()


def _matrix(arrays: Mapping[str, NDArray[Any]], name: str) -> Matrix:
    """Put a matrix together; unchecked, an index out of range crashes a product."""
    data = _vector(arrays, f"{name}_data")
    if not np.isfinite(data).all():
        raise ValueError(f"{name}_data holds NaN or inf; expected finite numbers")
    indices, indptr, shape = (arrays[f"{name}_{part}"] for part in _PARTS[1:])
    if {indices.dtype.kind, indptr.dtype.kind, shape.dtype.kind} - set("iu"):
        raise ValueError(f"{name}_indices, _indptr and _shape must hold integers")
    try:
        M = csc_array((data, indices, indptr), shape=tuple(shape.tolist()))
        M.check_format(full_check=True)
    except ValueError as e:
        raise ValueError(f"{name} is no matrix in CSC parts: {e}") from None
    return M
