"""Built cases on disk: ``FOLDER/DIGEST.npz``, a QP under the digest of its content.

``FOLDER/KEY.json`` says which QP a case is: the key names the case and the environment
that it was built in, so that another version of the code builds its own. Several
processes may use one folder. An entry whose content is not that of its digest is built
anew.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import blake2b, file_digest, sha256
from pathlib import Path
from typing import Any

from harness.durable import replace_file
from harness.names import CaseName


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A built case."""

    qp: Path  #: see `harness.qpfile`
    digest: str  #: of the content of that file
    meta: Mapping[str, Any]  #: of the case, as the generator told it


def entry(
    folder: Path,
    name: CaseName,
    environment: str,
    make: Callable[[Path], Mapping[str, Any]],
) -> Entry:
    """Find a case, or have it built by the one process that comes first.

    environment : digest of what the case is built with
    make : writes the QP to a file and returns the meta data; what it raises comes
        through and leaves no entry
    """
    folder.mkdir(parents=True, exist_ok=True)
    identity = [name.family, name.params, name.form, environment]
    key = sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:16]
    with _held(folder / f"{key}.lock"):
        found = _found(folder, key)
        if found is not None:
            return found
        new = folder / f"{key}.new"
        try:
            meta = make(new)
            digest = content_digest(new)
            os.replace(new, folder / f"{digest}.npz")
        finally:
            new.unlink(missing_ok=True)
        text = json.dumps({"digest": digest, "name": identity, "meta": meta})
        replace_file(folder / f"{key}.json", text.encode())
        return Entry(qp=folder / f"{digest}.npz", digest=digest, meta=meta)


def content_digest(path: Path) -> str:
    """Hash the content of a file."""
    with path.open("rb") as file:
        return file_digest(file, lambda: blake2b(digest_size=12)).hexdigest()


def _found(folder: Path, key: str) -> Entry | None:
    """Look up an entry; None where there is none, or none that can be trusted."""
    try:
        index = json.loads((folder / f"{key}.json").read_text("utf-8"))
        path = folder / f"{index['digest']}.npz"
        if content_digest(path) != index["digest"]:
            return None
        return Entry(qp=path, digest=index["digest"], meta=index["meta"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


@contextmanager
def _held(lock: Path) -> Iterator[None]:
    """Have one process at a time look up or build a case."""
    fd = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)  # which unlocks
