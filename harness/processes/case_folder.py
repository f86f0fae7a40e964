"""Built cases on disk: ``FOLDER/DIGEST.npz``, a QP under the digest of its content.

``FOLDER/KEY.json`` says which QP a case is: the key names the case and the environment
that it was built in, so that another version of the code builds its own. Several
processes may use one folder. Each file is stored with a digest, and an entry with a
damaged file is built again. Digests are not signatures: whoever writes to the folder
can store another QP under the name of a case (docs/security.md).
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
    """A built case."""

    qp: Path  #: see `harness.files.qpfile`
    digest: str  #: of the content of that file
    meta: Mapping[str, Any]  #: of the case, as the case worker told it


def find_or_build(
    folder: Path,
    identity: Sequence[Any],
    make: Callable[[Path], Mapping[str, Any]],
) -> StoredCase:
    """Find a case, or have it built by the one process that comes first.

    folder : made if need be, in one that is there
    identity : plain data: of the case, and of what it is built with
    make : writes the QP to a file, on the disk, and returns the meta data; what it
        raises comes through and leaves no entry
    """
    folder.mkdir(exist_ok=True)  # in one that is there, or was moved away
    key = hex_digest([json.dumps(identity, sort_keys=True).encode()], 16)
    with _locked(folder / f"{key}.lock"):
        found = _look_up(folder, key)
        if found is not None:
            return found
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
        replace_file(folder / f"{key}.json", text.encode())
        return StoredCase(qp=path, digest=digest, meta=meta)


def content_digest(path: Path) -> str:
    """Hash the content of a file."""
    with path.open("rb") as file:
        return hex_digest(pieces(file), 24)


def _look_up(folder: Path, key: str) -> StoredCase | None:
    """Look up an entry; return None if there is none, or a damaged one."""
    try:
        index = json.loads(read_text(folder / f"{key}.json"))
        if index.pop("check") != _check(index):
            return None
        path = folder / f"{index['digest']}.npz"
        if path.stat().st_size != index["bytes"]:  # it would be read to its end
            return None
        if content_digest(path) != index["digest"]:
            return None
        return StoredCase(qp=path, digest=index["digest"], meta=index["meta"])
    except (
        InputError, OSError, ValueError, KeyError, TypeError, AttributeError,
        RecursionError,
    ):  # fmt: skip
        return None


def _check(index: Mapping[str, Any]) -> str:
    """Hash an index, whose meta data no digest of the QP protects from damage."""
    return hex_digest([json.dumps(index, sort_keys=True).encode()], 16)


@contextmanager
def _locked(lock: Path) -> Iterator[None]:
    """Have one process at a time look up or build a case."""
    fd = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)  # which unlocks
