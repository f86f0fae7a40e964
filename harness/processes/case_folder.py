"""Built cases on disk: ``FOLDER/DIGEST.npz``, a QP under the digest of its content.

``FOLDER/KEY.json`` says which QP a case is: the key names the case and the environment
that it was built in, so that another version of the code builds its own. Several
processes may use one folder. An entry whose content is not that of its digest is built
anew, and so is one that another user wrote: a folder that somebody sent could else hold
another QP under the name of a case, with verdicts that are true of that one. So entries
are signed with a key that lies outside, ``~/.local/state/mortarbench/key``.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from hmac import compare_digest
from hmac import digest as keyed_digest
from pathlib import Path
from secrets import token_bytes
from typing import Any

from mortarbench.harness.digest import hex_digest, pieces
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.durable import keep_private, move_file, replace_file
from mortarbench.harness.files.reading import read_text

_KEY_BYTES = 32


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A built case."""

    qp: Path  #: see `harness.files.qpfile`
    digest: str  #: of the content of that file
    meta: Mapping[str, Any]  #: of the case, as the case worker told it


def entry(
    folder: Path,
    identity: Sequence[Any],
    make: Callable[[Path], Mapping[str, Any]],
) -> Entry:
    """Find a case, or have it built by the one process that comes first.

    folder : made if need be, in one that is there
    identity : plain data: of the case, and of what it is built with
    make : writes the QP to a file, on the disk, and returns the meta data; what it
        raises comes through and leaves no entry
    """
    folder.mkdir(exist_ok=True)  # in one that is there, or was moved away
    key = hex_digest([json.dumps(identity, sort_keys=True).encode()], 16)
    with _held(folder / f"{key}.lock"):
        found = _found(folder, key)
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
        text = json.dumps({**index, "signature": _signature(index)})
        replace_file(folder / f"{key}.json", text.encode())
        return Entry(qp=path, digest=digest, meta=meta)


def content_digest(path: Path) -> str:
    """Hash the content of a file."""
    with path.open("rb") as file:
        return hex_digest(pieces(file), 24)


def _found(folder: Path, key: str) -> Entry | None:
    """Look up an entry; None where there is none, or none that can be trusted."""
    try:
        index = json.loads(read_text(folder / f"{key}.json"))
        signature = index.pop("signature")
        if not compare_digest(signature, _signature(index)):
            return None
        path = folder / f"{index['digest']}.npz"
        if path.stat().st_size != index["bytes"]:  # it would be read to its end
            return None
        if content_digest(path) != index["digest"]:
            return None
        return Entry(qp=path, digest=index["digest"], meta=index["meta"])
    except (
        InputError, OSError, ValueError, KeyError, TypeError, AttributeError,
        RecursionError,
    ):  # fmt: skip
        return None


def _signature(index: Mapping[str, Any]) -> str:
    """Sign an entry, so that no other user can have written it."""
    text = json.dumps(index, sort_keys=True).encode()
    return keyed_digest(user_key(), text, "sha256").hex()


@cache
def user_key() -> bytes:
    """Read the key of this user, made at the first time.

    Where no file can keep it, it is another one in every process: entries of earlier
    runs are built again.
    """
    state = os.environ.get("XDG_STATE_HOME") or "~/.local/state"
    path = Path(os.path.expanduser(state)) / "mortarbench" / "key"
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not path.exists():
            keep_private(path, token_bytes(_KEY_BYTES))
        fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        with os.fdopen(fd, "rb") as file:
            private = os.fstat(fd).st_uid == os.getuid()
            key = file.read(_KEY_BYTES)
    except OSError:
        return token_bytes(_KEY_BYTES)
    return key if private and len(key) == _KEY_BYTES else token_bytes(_KEY_BYTES)


@contextmanager
def _held(lock: Path) -> Iterator[None]:
    """Have one process at a time look up or build a case."""
    fd = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)  # which unlocks
