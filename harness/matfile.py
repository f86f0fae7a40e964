"""One QP in one .mat file, for MATLAB and Octave; names as in `harness.qpfile`.

Vectors ``q, h, b, lb, ub`` are columns, matrices ``P, G, A`` sparse, ``meta`` is a JSON
text. Next to them lie what a case offers of its own, e.g. F, d, B, c, R of the paper.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, savemat
from scipy.io.matlab import MatReadError
from scipy.sparse import csc_array, issparse

from harness.errors import InputError
from harness.qp import QP, Matrix, Vector
from harness.qpfile import explicit_matrices

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
    """Read every variable of a .mat file.

    Raises
    ------
    InputError
        When it cannot be read, or is no .mat file of MATLAB 4 to 7.2.

    """
    try:
        with path.open("rb") as file:
            return dict(loadmat(file, spmatrix=False))
    except OSError as e:
        raise InputError(f"{path}: {e.strerror or e}; expected a .mat file") from None
    except NotImplementedError:  # scipy's answer to HDF5
        raise InputError(
            f"{path}: a .mat file of version 7.3; save it with -v7"
        ) from None
    except (ValueError, TypeError, EOFError, MatReadError, OverflowError):
        raise InputError(
            f"{path}: not a .mat file; expected one saved with -v7 or older"
        ) from None


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
        meta = json.loads(str(np.asarray(arrays.get("meta", "{}")).item()))
        if not isinstance(meta, dict):
            raise ValueError("meta is no JSON object")
        for name in set(_MATRICES).intersection(meta.get("dense", ())):
            matrices[name] = matrices[name].toarray()
        return QP(**vectors, **matrices), meta
    except (ValueError, TypeError) as e:
        raise InputError(" ".join(str(e).split())) from None


def vector(arrays: Mapping[str, Any], name: str) -> Vector:
    """Take the numbers of a row, a column or a sparse one, (n,)."""
    M = matrix(arrays, name)
    if M.size and 1 not in M.shape:
        raise InputError(f"{name} is of shape {M.shape}; expected one row or column")
    flat: Vector = M.toarray().ravel()
    return flat


def matrix(arrays: Mapping[str, Any], name: str) -> Matrix:
    """Take a matrix of numbers, dense or sparse, as csc."""
    if name not in arrays:
        raise InputError(f"{name} is missing")
    if not issparse(arrays[name]) and np.asarray(arrays[name]).dtype.kind not in "iufb":
        raise InputError(f"{name} is no matrix of numbers")
    M = csc_array(arrays[name], dtype=float)
    if np.isnan(M.data).any():
        raise InputError(f"{name} holds NaN; expected numbers")
    return M
