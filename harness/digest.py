"""Digests that identify files, arrays, environments and measurements."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from hashlib import sha256
from typing import IO

_PIECE_BYTES = 2**20  #: number of bytes that are read in one call


def hex_digest(parts: Iterable[bytes], digits: int = 12) -> str:
    """Return the first digits of the SHA-256 of the concatenated `parts`.

    digits : number of hexadecimal digits, at most 64

    >>> from mortarbench.harness.digest import hex_digest
    >>> hex_digest([b"a", b"b"]) == hex_digest([b"ab"])
    True
    """
    content = sha256()
    for part in parts:
        content.update(part)
    return content.hexdigest()[:digits]


def pieces(file: IO[bytes]) -> Iterator[bytes]:
    """Yield the unread content of an open file in pieces of at most 1 MiB."""
    while piece := file.read(_PIECE_BYTES):
        yield piece
