"""The digest that names content: of files, arrays, environments, measurements."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from hashlib import sha256
from typing import IO, TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from hashlib import _Hash

Digest: TypeAlias = "_Hash"  #: of parts so far; ``update`` takes another one

_PIECE = 2**20  #: bytes that are read at once


def hex_digest(parts: Iterable[bytes], digits: int = 12) -> str:
    """Give the first hexadecimal digits of the SHA-256 of `parts`, one after another.

    digits : 64 at most; each has 4 bits
    """
    return running_digest(parts).hexdigest()[:digits]


def running_digest(parts: Iterable[bytes]) -> Digest:
    """Hash `parts`, one after another, so that more can follow by ``update``."""
    content = sha256()
    for part in parts:
        content.update(part)
    return content


def pieces(file: IO[bytes]) -> Iterator[bytes]:
    """Read what is left of a file, piece by piece."""
    while piece := file.read(_PIECE):
        yield piece
