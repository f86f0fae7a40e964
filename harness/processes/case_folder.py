"""Cache of built cases on disk, shared by the processes of a run.

``FOLDER/DIGEST.npz`` contains a QP and is named after the digest of its content.
``FOLDER/KEY.json`` maps a case to such a file. KEY is a digest of the case and of the
environment in which it is built, so that each version of the code has its own entry.
Both files are checked by digests when they are read, and a case is built again if one
of them is damaged. Digests are not signatures: anyone who can write to the folder can
store a different QP under the name of a case (docs/policy.md).
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mortarbench.harness.digest import hex_digest, pieces
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.durable import move_file, replace_file
from mortarbench.harness.files.reading import read_text
from mortarbench.harness.processes.locks import file_lock

#: errors of reading an index of unexpected content
_DAMAGE = (ValueError, KeyError, TypeError, AttributeError, RecursionError)


@dataclass(frozen=True, kw_only=True)
class StoredCase:
    """Built case in the cache."""

    qp: Path  #: file that contains the QP, see `harness.files.qpfile`
    digest: str  #: digest of the content of that file
    meta: Mapping[str, Any]  #: meta data that `make` returned, see `find_or_build`


def find_or_build(
    folder: Path,
    identity: Sequence[Any],
    make: Callable[[Path], Mapping[str, Any]],
) -> StoredCase:
    """Return a case from the folder, building it first if it is missing or damaged.

    While one process looks up or builds a case, other processes that need it wait.

    folder : folder of the cache; created if missing, but its parent must exist
    identity : plain data that identify the case and the environment of the build
    make : writes the QP to a file, flushes the file and returns the meta data. If
        `make` raises an exception, nothing is stored and the exception propagates
    """
    folder.mkdir(exist_ok=True)  # fails if the result folder was moved
    key = hex_digest([json.dumps(identity, sort_keys=True).encode()], 16)
    with file_lock(folder / f"{key}.lock", flags=os.O_RDWR | os.O_CREAT):
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
        # Write the index last, so that a killed build leaves no entry.
        replace_file(folder / f"{key}.json", text.encode())
        return StoredCase(qp=path, digest=digest, meta=meta)


def content_digest(path: Path) -> str:
    """Return 24 hex digits of the SHA-256 of a file's content."""
    with path.open("rb") as file:
        return hex_digest(pieces(file), 24)


def _look_up(folder: Path, key: str) -> StoredCase | None:
    """Return the stored case of a key, or None if it is missing or damaged."""
    try:
        index = json.loads(read_text(folder / f"{key}.json"))
        if index.pop("check") != _check(index):
            return None
        path = folder / f"{index['digest']}.npz"
        # Compare sizes first, since hashing would read an enlarged file completely.
        if path.stat().st_size != index["bytes"]:
            return None
        if content_digest(path) != index["digest"]:
            return None
        return StoredCase(qp=path, digest=index["digest"], meta=index["meta"])
    except (InputError, OSError, *_DAMAGE):
        return None


def _check(index: Mapping[str, Any]) -> str:
    """Return the digest of an index, whose meta data the QP's digest does not cover."""
    return hex_digest([json.dumps(index, sort_keys=True).encode()], 16)
