"""Content-addressed arrays of a result folder: ``FOLDER/vectors/DIGEST.npz``."""

from __future__ import annotations

import re
import shutil
import warnings
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.digest import hex_digest
from mortarbench.harness.errors import InputError, shortened
from mortarbench.harness.files import npz
from mortarbench.harness.files.durable import replace_file, replacing
from mortarbench.harness.files.reading import opened
from mortarbench.harness.plugin import ContactSide, Fields
from mortarbench.harness.solution import Solution, Status, checked_history

Arrays = Mapping[str, NDArray[Any]]

_DIGEST = re.compile("[0-9a-f]{16}")
POINT = ("x", "y", "z", "z_box")
_NODAL = "nodal_"
#: prefix of the names of the arrays of a contact side, with the number of the side
_SIDE = "side_{}_"
_HISTORY = "history_"


def load_solution(folder: Path, digest: str, status: Status) -> Solution:
    """Load a stored point as a `Solution` that claims `status`.

    Raises
    ------
    InputError
        If the file is missing or damaged, or its content does not match `digest`.

    """
    return _solution(_path(folder, digest), _stored(folder, digest, POINT), status)


def field_arrays(fields: Fields) -> Arrays:
    """Return the arrays of a deformed state by name."""
    arrays = {**vars(fields)}
    nodal, sides = arrays.pop("nodal"), arrays.pop("contacts")
    arrays |= {_NODAL + name: values for name, values in nodal.items()}
    for i, side in enumerate(sides):
        arrays |= {_SIDE.format(i) + name: v for name, v in vars(side).items()}
    return {k: np.asarray(v) for k, v in arrays.items() if v is not None}


def load_fields(folder: Path, digest: str) -> Fields:
    """Load a stored deformed state.

    Raises
    ------
    InputError
        If the file is missing or damaged, or its content does not match `digest`.

    """
    arrays = _stored(folder, digest, ("points", "displacement"))
    sides: list[ContactSide] = []
    while side := with_prefix(_SIDE.format(len(sides)), arrays):
        sides.append(ContactSide(name=str(side.pop("name")), **side))
    known = {k: v for k, v in arrays.items() if not k.startswith((_NODAL, "side_"))}
    nodal = with_prefix(_NODAL, arrays)
    return Fields(nodal=nodal, contacts=tuple(sides), **known)


def write_point(path: Path, solution: Solution) -> None:
    """Write the point and the history of a solution to a file."""
    write_arrays(path, point_arrays(solution))


def write_arrays(path: Path, arrays: Arrays) -> None:
    """Write arrays to an npz file."""
    with path.open("wb") as file:  # np.savez would append .npz to a path
        np.savez(file, **arrays)  # type: ignore[arg-type]


def read_point(path: Path, status: Status) -> Solution:
    """Read a file written by `write_point` as a `Solution` that claims `status`."""
    return _solution(path, read_arrays(path, POINT), status)


def _solution(path: Path, arrays: Arrays, status: Status) -> Solution:
    try:
        history = checked_history(with_prefix(_HISTORY, arrays))
    except ValueError as e:
        raise InputError(f"{path}: malformed history: {e}") from None
    x, y, z, z_box = (arrays[name] for name in POINT)
    return Solution(status=status, x=x, y=y, z=z, z_box=z_box, history=history)


def read_arrays(path: Path, expected: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """Read an npz file without unpickling.

    Raises
    ------
    InputError
        If the file cannot be read, is not an npz file, is larger than
        `harness.files.reading` allows, or lacks one of the `expected` arrays.

    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            arrays = npz.read(path)
    except InputError:
        raise
    except Exception:  # zipfile raises many types for texts, pickles and damaged files
        raise InputError(
            f"{path}: not an npz file of plain arrays; expected a file written by "
            "numpy.savez"
        ) from None
    if missing := [name for name in expected if name not in arrays]:
        raise InputError(f"{path}: {', '.join(missing)} missing")
    return arrays


def point_arrays(solution: Solution) -> Arrays:
    """Return the vectors of a point and the columns of its history by name."""
    point = {name: getattr(solution, name) for name in POINT}
    return point | {_HISTORY + name: v for name, v in solution.history.items()}


def with_prefix(prefix: str, arrays: Arrays) -> dict[str, NDArray[Any]]:
    """Return the arrays whose names have a prefix, by name without the prefix."""
    return {
        name.removeprefix(prefix): values
        for name, values in arrays.items()
        if name.startswith(prefix)
    }


def _stored(
    folder: Path, digest: str, expected: tuple[str, ...]
) -> dict[str, NDArray[Any]]:
    """Read stored arrays; raise InputError with a remedy if they are damaged."""
    path = _path(folder, digest)
    try:
        arrays = read_arrays(path, expected)
        if digest_of(arrays) != digest:
            raise InputError(f"{path}: its content does not match its digest")
    except InputError as e:
        raise InputError(f"{e}; restore the file, or run with --fresh") from None
    return arrays


def is_stored(folder: Path, digest: str) -> bool:
    """Return True if a folder contains arrays with that digest."""
    return bool(_DIGEST.fullmatch(digest)) and _path(folder, digest).exists()


def copy_stored(source: Path, folder: Path, digest: str) -> bool:
    """Copy stored arrays to another result folder; return False if `source` lacks them.

    If `folder` already has arrays with this digest, nothing is copied.
    """
    if is_stored(folder, digest):
        return True
    if not is_stored(source, digest):
        return False
    with opened(_path(source, digest), "stored arrays") as file:
        (folder / "vectors").mkdir(parents=True, exist_ok=True)
        with replacing(_path(folder, digest)) as copy:
            shutil.copyfileobj(file, copy)
    return True


def _path(folder: Path, digest: str) -> Path:
    """Check that a text is a digest, and return the path of the stored arrays.

    Any other text might contain a path that leads out of the folder.
    """
    if not _DIGEST.fullmatch(digest):
        raise InputError(
            f"{folder}: {shortened(digest)!r} is not a digest; expected 16 hex digits"
        )
    return folder / "vectors" / f"{digest}.npz"


def save(folder: Path, arrays: Arrays) -> str:
    """Store arrays under the digest of their content, and return the digest."""
    digest = digest_of(arrays)
    path = _path(folder, digest)
    if path.exists():
        return digest
    archive = BytesIO()
    np.savez(archive, **arrays)  # type: ignore[arg-type]
    # flushed to the disk before the journal line that refers to the file is written
    # not `getbuffer`: if the write fails, Python 3.13 may report that the archive was
    # collected while this view of it existed
    replace_file(path, archive.getvalue())
    return digest


def digest_of(arrays: Arrays) -> str:
    """Return the digest of the names, types, shapes and values of arrays.

    The npz file itself is not hashed, since it contains dates.
    """

    def parts() -> Iterator[bytes]:
        for name in sorted(arrays):
            array = np.ascontiguousarray(arrays[name])
            yield f"{name} {array.dtype.str} {arrays[name].shape}\n".encode()
            yield array.tobytes()

    return hex_digest(parts(), 16)
