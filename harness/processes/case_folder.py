"""Cache of built cases on disk, shared by the processes of a run.

``FOLDER/DIGEST.npz`` contains a QP and is named after the digest of its content.
``FOLDER/KEY.json`` maps a case to such a file. The key is a digest of the case and of
the environment of its build, so that each version of the code has its own entry. Every
file is stored with a digest, and a case whose file is damaged is built again. Digests
are not signatures: anyone who can write to the folder can store another QP under the
name of a case (docs/security.md).
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mortarbench.harness.digest import hex_digest, pieces
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.durable import move_file, replace_file
from mortarbench.harness.files.reading import read_text


@dataclass(frozen=True, kw_only=True)
class StoredCase:
    """A built case in the folder."""

    qp: Path  #: file that contains the QP, see `harness.files.qpfile`
    digest: str  #: digest of the content of that file
    meta: Mapping[str, Any]  #: meta data that the case worker reported


def find_or_build(
    folder: Path,
    identity: Sequence[Any],
    make: Callable[[Path], Mapping[str, Any]],
) -> StoredCase:
    """Return a case from the folder, building it first if it is missing or damaged.

    Only one process at a time looks up or builds a case; the others wait.

    folder : created if it does not exist; its parent must exist
    identity : plain data that identify the case and the environment of the build
    make : writes the QP to a file, flushes it and returns the meta data. Exceptions
        propagate, and nothing is stored then
    """
    folder.mkdir(exist_ok=True)  # without parents: fails if the folder was moved
    key = hex_digest([json.dumps(identity, sort_keys=True).encode()], 16)
    with _locked(folder / f"{key}.lock"):
        stored = _look_up(folder, key)
        if stored is not None:
            return stored
        new = folder / f"{key}.new"
        try:
            meta = make(new)
            digest = content_digest(new)
            move_file(new, folder / f"{digest}.npz")
        finally:
            new.unlink(missing_ok=True)
        path = folder / f"{digest}.npz"
        size = path.stat().st_size
        index = {"digest": digest, "bytes": size, "name": identity, "meta": meta}
        text = json.dumps({**index, "check": _check(index)})
        # The index comes last: a build that is killed before leaves no entry.
        replace_file(folder / f"{key}.json", text.encode())
        return StoredCase(qp=path, digest=digest, meta=meta)


def content_digest(path: Path) -> str:
    """Hash the content of a file."""
    with path.open("rb") as file:
        return hex_digest(pieces(file), 24)


def _look_up(folder: Path, key: str) -> StoredCase | None:
    """Return the stored case of a key, or None if it is missing or damaged."""
    try:
        index = json.loads(read_text(folder / f"{key}.json"))
        if index.pop("check") != _check(index):
            return None
        path = folder / f"{index['digest']}.npz"
        # Sizes first: hashing would read a file that was enlarged to its end.
        if path.stat().st_size != index["bytes"]:
            return None
        if content_digest(path) != index["digest"]:
            return None
        return StoredCase(qp=path, digest=index["digest"], meta=index["meta"])
    except (
        InputError,
        OSError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        RecursionError,
    ):
        return None


def _check(index: Mapping[str, Any]) -> str:
    """Hash an index: the digest of the QP does not cover its meta data."""
    return hex_digest([json.dumps(index, sort_keys=True).encode()], 16)


@contextmanager
def _locked(lock: Path) -> Iterator[None]:
    """Hold an exclusive lock on a file; it is released when its process ends."""
    fd = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)  # also releases the lock
