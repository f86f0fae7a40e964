"""Reading of data files from untrusted sources, within the limit of `reading`."""

from __future__ import annotations

import gzip
import os
import resource
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mortarbench.harness.digest import hex_digest, pieces
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.reading import (
    MIB,
    VARIABLE,
    check_size,
    max_bytes,
    opened,
)

_PARSER_BYTES = 256 * MIB  #: memory that a parser may use in addition to the data


def content(path: Path, expected: str, *, copies: int = 1) -> bytes:
    """Read a whole file, and decompress it with gzip if its name ends in .gz.

    expected : description of the file, for messages
    copies : number of copies of the content that the caller's parser may keep in memory
        at once; their total size must not exceed the memory limit

    Raises
    ------
    InputError
        For the same reasons as in `opened`, if the content would exceed the limit, or
        if it cannot be decompressed.

    """
    with opened(path, expected) as file:
        size = os.fstat(file.fileno()).st_size
        check_size(f"{path}: its content", copies * size)
        if path.suffix.lower() != ".gz":
            return file.read(size)
        most = max_bytes() // copies
        try:
            with gzip.GzipFile(fileobj=file) as whole:
                data = whole.read(most + 1)
        # the content is not gzip data, is truncated, or is damaged
        except (OSError, EOFError, zlib.error):
            raise InputError(
                f"{path}: not a gzip file, or damaged; expected {expected}, compressed"
            ) from None
    if len(data) > most:
        raise InputError(
            f"{path}: its expanded content would take more than {max_bytes() // MIB} "
            f"MiB of memory with its parser; expected less (set {VARIABLE} to allow "
            "more)"
        )
    return data


def content_digest(*paths: Path) -> str:
    """Return 12 hexadecimal digits of the SHA-256 of the concatenated files.

    Raises
    ------
    InputError
        For the same reasons as in `opened`.

    """

    def parts() -> Iterator[bytes]:
        for path in paths:
            with opened(path, "a readable file") as file:
                yield from pieces(file)

    return hex_digest(parts(), 12)


@contextmanager
def parsing(path: Path, wrong: str, room: int) -> Iterator[None]:
    """Convert exceptions that a parser raises in the block to an InputError.

    wrong : message of the error
    room : bytes by which the address space may grow in the block, in addition to the
        256 MiB that every parser may use

    Raises
    ------
    InputError
        If any exception or warning is raised in the block.

    """
    room += _PARSER_BYTES
    try:
        with warnings.catch_warnings(), at_most(room):
            warnings.simplefilter("error")
            yield
    except InputError:
        raise
    except MemoryError:
        raise InputError(
            f"{path}: would take more than {room // MIB} MiB of memory, although its "
            "size and its header declare less; expected an undamaged file"
        ) from None
    except Exception:  # damaged files cause many types of exceptions
        raise InputError(f"{path}: {wrong}") from None


@contextmanager
def at_most(size: int) -> Iterator[None]:
    """Limit the growth of the address space of this process to `size` bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * os.sysconf("SC_PAGE_SIZE") + size
    finite = [k for k in (limit, soft, hard) if k != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_AS, (min(finite), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
