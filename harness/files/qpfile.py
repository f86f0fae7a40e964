"""QPs in files: npz files without pickles, and files that workers map into memory.

::

    min ½xᵀPx + qᵀx   s.t.   Gx ≤ h,  Ax = b,  lb ≤ x ≤ ub

is stored as

* the vectors ``q, h, b, lb, ub``,
* the arrays ``M_data, M_indices, M_indptr, M_shape`` of the CSC format of each matrix M
  of ``P, G, A``, with both triangles of P,
* the arrays of sets other than bounds, such as ``disc_index, disc_radius``, with the
  names of `harness.sets.arrays`, and
* ``meta``, a JSON object, whose entry ``dense`` lists the matrices that were dense.

Absent constraints have zero rows, and absent bounds are ±inf. The optional structure of
a dual QP (`harness.qp.Structure`) is stored as the matrices ``K, B`` and the vector
``fixed``.

Workers exchange the same arrays in the format of `harness.files.mapped`.

Files written by ``np.savez(path, P=P, q=q, G=G, h=h)`` and by ``Problem.save`` of
qpsolvers are also accepted. In these files, matrices are dense arrays or CSC parts, and
``G, h``, ``A, b``, bounds and sets are optional or None.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from math import prod
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, issparse

from mortarbench.harness.checked import located
from mortarbench.harness.errors import InputError, shortened, unknown
from mortarbench.harness.files.durable import writing
from mortarbench.harness.files.mapped import read_mapped, write_mapped
from mortarbench.harness.files.reading import check_size
from mortarbench.harness.files.store import digest_of, read_arrays, with_prefix
from mortarbench.harness.operators import Maker, SerialisableOperator, assembled
from mortarbench.harness.qp import (
    QP,
    Matrix,
    Structure,
    Vector,
    canonical,
)
from mortarbench.harness.sets.arrays import SET_ARRAY, further_sets, set_arrays

VECTORS = ("q", "h", "b", "lb", "ub")
_MATRICES = ("P", "G", "A")
_STRUCTURE = ("K", "B")
_PARTS = ("data", "indices", "indptr", "shape")
_INGREDIENT = "P_from_"  #: prefix of the arrays of a serialised operator P
_PLAIN = {*VECTORS, *_MATRICES} | {f"{M}_{part}" for M in _MATRICES for part in _PARTS}


def explicit_matrices(qp: QP) -> tuple[dict[str, Matrix], list[str]]:
    """Return the matrices P, G and A by name, and the names of the dense matrices.

    Raises
    ------
    InputError
        If P is an operator that is too large to be assembled.

    """
    P = qp.P
    if not qp.is_explicit:
        n = qp.q.size
        check_size(f"the operator P as a dense matrix of {n} rows", 8 * n**2)
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
    """Write `qp` to `path`, and return the digest of its coefficients.

    An operator P is assembled and stored as a dense matrix. The digest has 16 hex
    digits. Equal digests mean equal QPs; a serialised operator and its assembled matrix
    have different digests.

    meta : plain data; the key ``dense`` and, if P is serialised, ``maker`` are
        overwritten
    serialised : store a `SerialisableOperator` P by its arrays instead of assembling
        it; only workers of the same run can read such a file

    Raises
    ------
    InputError
        If the file cannot be written, or P is an operator that is too large to be
        assembled.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np
    >>> from mortarbench import QP
    >>> from mortarbench.harness import save_qp
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "small.npz")
    ...     digest = save_qp(path, QP.from_arrays(np.eye(2), [-1, -1], lb=0))
    ...     np.load(path)["q"]
    array([-1., -1.])

    """
    arrays, entries = _parts(qp, serialised=serialised)
    digest = digest_of(arrays)
    arrays["meta"] = np.array(json.dumps({**meta, **entries}))
    if serialised:
        write_mapped(path, arrays)
        return digest
    with writing(path) as file:
        np.savez(file, **arrays)
    return digest


def qp_digest(qp: QP, *, serialised: bool = False) -> str:
    """Return the digest of the coefficients of a QP (see `save_qp`)."""
    return digest_of(_parts(qp, serialised=serialised)[0])


def _parts(qp: QP, *, serialised: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the arrays to store for a QP, and the entries of its meta data.

    The entries are the names of the dense matrices (``dense``) and, if P is serialised,
    the name of its maker.
    """
    arrays: dict[str, Any] = {name: getattr(qp, name) for name in VECTORS}
    arrays |= set_arrays(qp.sets[1:])
    entries: dict[str, Any] = {}
    if serialised and isinstance(P := qp.P, SerialisableOperator):
        arrays |= {_INGREDIENT + name: array for name, array in P.arrays.items()}
        entries["maker"] = P.maker
        qp = replace(qp, P=csc_array(P.shape))
    matrices, entries["dense"] = explicit_matrices(qp)
    if serialised and qp.structure is not None:
        matrices |= {name: getattr(qp.structure, name) for name in _STRUCTURE}
        arrays["fixed"] = qp.structure.fixed
    for name, M in matrices.items():
        M = csc_array(M)
        parts = (M.data, M.indices, M.indptr, np.array(M.shape))
        arrays |= {f"{name}_{k}": a for k, a in zip(_PARTS, parts, strict=True)}
    return arrays, entries


def load_qp(
    path: Path, *, operators: Mapping[str, Maker] | None = None
) -> tuple[QP, dict[str, Any]]:
    """Read a QP and its meta data.

    operators : makers of operators by name (`harness.operators`), for a file that
        `save_qp` has written with `serialised`. None for an npz file, whose size is
        limited by `harness.files.reading`

    Raises
    ------
    InputError
        If the file cannot be read, lacks an array, or its arrays do not define a valid
        QP.

    """
    if operators is None:
        arrays = read_arrays(path, ())
        with malformed(path):
            return qp_of(arrays)
    with malformed(path):
        try:
            arrays = read_mapped(path)
        except OSError as e:
            raise InputError(e.strerror) from None
        meta = _meta(arrays)
        return _serialised_qp(arrays, meta, operators), meta


@contextmanager
def malformed(path: Path) -> Iterator[None]:
    """Convert errors of arrays that define no QP to an InputError that names a file."""
    with located(f"{path}"):
        try:
            yield
        except KeyError as e:
            raise InputError(f"{e} is missing") from None
        except (ValueError, TypeError, OverflowError) as e:
            raise InputError(shortened(" ".join(str(e).split()))) from None


def _meta(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Return the meta data of a file; they are empty if the file has none."""
    array = arrays.get("meta", np.array("{}"))
    if array.dtype.kind != "U" or array.size != 1:
        raise ValueError("meta is not a string")
    try:
        data = json.loads(str(array.item()))
    except RecursionError:
        raise ValueError("meta is nested too deeply") from None
    if not isinstance(data, dict):
        raise ValueError("meta is not a JSON object")
    return data


def _serialised_qp(
    arrays: Mapping[str, NDArray[Any]],
    meta: Mapping[str, Any],
    operators: Mapping[str, Maker],
) -> QP:
    """Return the QP of a file written with `serialised`; arrays are not copied."""
    matrices = {name: _matrix(arrays, name) for name in _MATRICES}
    for name in meta["dense"]:
        # if all entries are stored, use a view of the values, which may be mapped
        M = matrices[name]
        rows, columns = M.shape
        full = M.nnz == rows * columns and M.has_canonical_format
        matrices[name] = M.data.reshape(columns, rows).T if full else M.toarray()
    vectors: dict[str, Any] = {name: arrays[name] for name in VECTORS}
    if "maker" in meta:
        n, maker = vectors["q"].size, str(meta["maker"])
        ingredients = with_prefix(_INGREDIENT, arrays)
        matrices["P"] = SerialisableOperator(n, maker, ingredients, operators)
    structure = None
    if "fixed" in arrays:
        K, B = (_matrix(arrays, name) for name in _STRUCTURE)
        structure = Structure(K=K, B=B, fixed=arrays["fixed"])
    return QP(**vectors, **matrices, structure=structure, sets=further_sets(arrays))


def qp_of(arrays: Mapping[str, NDArray[Any]]) -> tuple[QP, dict[str, Any]]:
    """Check the arrays of a file of unknown origin, and return their QP and meta data.

    Raises
    ------
    InputError, ValueError, TypeError, OverflowError
        If the arrays define no valid QP.

    """
    meta = _meta(arrays)
    for name in arrays if "meta" not in arrays else ():
        if name not in _PLAIN and not SET_ARRAY.fullmatch(name):
            raise unknown("array", name, (*VECTORS, *_MATRICES))
    parts: dict[str, Any] = {name: stored_matrix(arrays, name) for name in _MATRICES}
    parts |= {name: _vector(arrays, name) for name in VECTORS if name in arrays}
    dense = meta.get("dense", [*_MATRICES])
    if not isinstance(dense, list) or not all(isinstance(n, str) for n in dense):
        raise ValueError("meta: dense is not a list of names")
    for name in _MATRICES:
        M = parts[name]
        if issparse(M) and "dense" in meta and name in dense:
            check_dense(name, M)
            parts[name] = M.toarray()
        elif isinstance(M, np.ndarray) and name not in dense:
            parts[name] = csc_array(M)
    qp = QP.from_arrays(**{"q": None, **parts}, sets=further_sets(arrays))
    return qp, meta


def stored_matrix(arrays: Mapping[str, NDArray[Any]], name: str) -> Matrix | None:
    """Return a matrix stored as an array or as CSC parts; None if it is missing."""
    if name in arrays:
        M = _vector(arrays, name)
        if M.ndim != 2:
            raise ValueError(f"{name} has shape {M.shape}; expected two dimensions")
        return M
    if not any(f"{name}_{part}" in arrays for part in _PARTS):
        return None
    return _matrix(arrays, name)


def check_dense(name: str, M: Matrix) -> None:
    """Check that a matrix would not exceed the memory limit as a dense array.

    Raises
    ------
    InputError
        If the dense array would exceed the limit of `harness.files.reading`.

    """
    check_size(f"{name}, dense and {M.shape[0]} × {M.shape[1]},", 8 * prod(M.shape))


def _vector(arrays: Mapping[str, NDArray[Any]], name: str) -> Vector:
    if arrays[name].dtype.kind not in "biuf":
        raise ValueError(f"{name} is of type {arrays[name].dtype}; expected numbers")
    # Values beyond the range of a double become inf, which callers reject.
    with np.errstate(over="ignore"):
        return arrays[name].astype(float, copy=False)


def _matrix(arrays: Mapping[str, NDArray[Any]], name: str) -> Matrix:
    """Check the CSC parts of a stored matrix, and return the matrix."""
    data = _vector(arrays, f"{name}_data")
    indices, indptr, shape = (arrays[f"{name}_{part}"] for part in _PARTS[1:])
    if {indices.dtype.kind, indptr.dtype.kind, shape.dtype.kind} - set("iu"):
        raise ValueError(f"{name}_indices, _indptr and _shape must contain integers")
    try:
        # Compare neighbouring entries, since SciPy (1.17.1) computes the differences of
        # indptr, which may overflow.
        if (indptr[1:] < indptr[:-1]).any():
            raise ValueError("indptr decreases")
        M = csc_array((data, indices, indptr), shape=tuple(shape.tolist()))
        M.check_format(full_check=True)  # an index out of range would crash a product
    except (ValueError, TypeError, OverflowError) as e:
        raise ValueError(f"{name} is not a matrix in CSC parts: {e}") from None
    return canonical(M)
