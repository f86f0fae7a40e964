"""Reading of npz files, which are zip archives of npy files, without unpickling."""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from mortarbench.harness.errors import InputError, shortened
from mortarbench.harness.files.reading import check_size, opened

EXPECTED = "an npz file"
#: kinds of dtypes that are read; records and objects, which are pickled, are refused
_KINDS = "biufcSU"


def read(path: Path) -> dict[str, NDArray[Any]]:
    """Read all arrays of a file without unpickling; an array that is None is left out.

    Raises
    ------
    InputError
        For the same reasons as in `harness.files.reading.opened`, if the arrays would
        exceed the memory limit, or if an array is pickled.
    ValueError, BadZipFile
        If the file is not an npz file of plain arrays.

    """
    with opened(path, EXPECTED) as file:
        return arrays_in(file, path)


def arrays_in(file: IO[bytes], path: Path) -> dict[str, NDArray[Any]]:
    """Read all arrays of an open npz file as in `read`; messages name `path`."""
    arrays: dict[str, NDArray[Any]] = {}
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        check_size(f"{path}: its content", sum(m.file_size for m in members))
        for member in members:
            name = member.filename.removesuffix(".npy")
            if name in arrays:
                raise ValueError(f"{shortened(name)!r} occurs twice")
            with archive.open(member) as part:
                try:
                    array = npy.read_array(part, allow_pickle=False)
                except ValueError:
                    if _is_pickled_none(archive.read(member), name, path):
                        continue
                    raise
                # also lets zipfile compare the checksum, at the end of the member
                if part.read(1) or array.dtype.kind not in _KINDS:
                    raise ValueError(f"{shortened(name)!r} is not a plain array")
            arrays[name] = array
    return arrays


def _is_pickled_none(member: bytes, name: str, path: Path) -> bool:
    """Return True if an npy file contains ``np.array(None)``; nothing is unpickled.

    NumPy writes protocol 4 or, before NumPy 2, protocol 3 with the former module names.
    An array of other Python objects, such as a SciPy matrix that NumPy saved, raises
    InputError.
    """
    head, _, data = member.partition(b"\n")
    new, old = (pickle.dumps(np.array(None), protocol=i) for i in (4, 3))
    if data in (new, old, old.replace(b"numpy._core", b"numpy.core")):
        return True
    if b"'|O'" in head:
        raise InputError(
            f"{path}: {shortened(name)} is a pickled Python object, which is never "
            "read; expected an array of numbers (for a sparse matrix, toarray(), or "
            "its parts P_data, P_indices, P_indptr, P_shape)"
        )
    return False
