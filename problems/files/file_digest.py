"""What a case rests on when it comes from files: their content, by digest."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from harness import InputError, Value
from harness.digest import hex_digest, pieces
from harness.files.datafile import opened


def digest(*paths: Path) -> str:
    """Digest the bytes of files, 12 hexadecimal digits of SHA-256.

    Raises
    ------
    InputError
        When one cannot be read, is no regular file, or is larger than
        `harness.files.datafile` allows.

    """

    def parts() -> Iterator[bytes]:
        for path in paths:
            with opened(path, "a file that can be read") as file:
                yield from pieces(file)

    return hex_digest(parts())


def check_digest(path: Value, asked: Value, found: str) -> None:
    """Raise InputError unless the content is what the case was named for."""
    if asked != found:
        raise InputError(
            f"{path}: its content has the digest {found}, not {asked}; "
            "the file changed, or another one was meant"
        )
