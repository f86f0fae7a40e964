"""The digest that names content: of files, arrays, environments, measurements."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from hashlib import sha256
from typing import IO

_PIECE = 2**20  #: bytes that are read at once


def hex_digest(parts: Iterable[bytes], digits: int = 12) -> str:
    """Give the first hexadecimal digits of the SHA-256 of `parts`, one after another.

    digits : 64 at most; each has 4 bits
    """
    content = sha256()
    for part in parts:
        content.update(part)
    return content.hexdigest()[:digits]


def pieces(file: IO[bytes]) -> Iterator[bytes]:
    """Read what is left of a file, piece by piece."""
    while piece := file.read(_PIECE):
        yield piece
