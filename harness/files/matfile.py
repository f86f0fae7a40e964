"""One QP in one .mat file, for MATLAB and Octave.

The variables have the same names as in `harness.files.qpfile`. The vectors ``q, h, b,
lb, ub`` are columns, the matrices ``P, G, A`` are sparse, and ``meta`` is a JSON text.
Indices of sets, such as ``disc_index``, start at 0. A case may add further arrays, for
instance the arrays F, d, B, c and R of the paper's dual QP.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from numpy.typing import NDArray
from scipy.io import savemat
from scipy.sparse import csc_array, issparse

from mortarbench.harness.errors import InputError
from mortarbench.harness.files.datafile import content
from mortarbench.harness.files.durable import writing
from mortarbench.harness.files.qpfile import VECTORS, explicit_matrices
from mortarbench.harness.files.reader import read_isolated
from mortarbench.harness.qp import QP
from mortarbench.harness.sets.arrays import set_arrays

_WRONG = "not a .mat file; expected a file saved with -v7 or older"
_HEADER_BYTES = 128  #: size of the header, which states the version


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
    arrays |= {name: getattr(qp, name) for name in VECTORS}
    arrays |= set_arrays(qp.sets[1:])
    arrays |= {name: csc_array(M) for name, M in matrices.items()}
    arrays["meta"] = json.dumps({**meta, "dense": dense})
    with writing(path) as file:
        savemat(file, arrays, do_compression=True, oned_as="column")


def read_mat(path: Path) -> dict[str, NDArray[Any]]:
    """Return numbers and texts of a .mat file by name, sparse matrices as CSC parts.

    Raises
    ------
    InputError
        If the file cannot be read, is not a .mat file of MATLAB 4 to 7.2, or contains
        more data than `harness.files.reading` allows.

    """
    data = content(path, "a .mat file")
    if b"MATLAB 7.3" in data[:_HEADER_BYTES] or data.startswith(b"\x89HDF"):
        raise InputError(f"{path}: a .mat file of version 7.3; save it with -v7")
    with TemporaryFile() as file:
        file.write(data)
        file.seek(0)
        return read_isolated(file, path, _WRONG, "mat")
