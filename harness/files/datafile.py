"""Data files that others made: regular ones only, of a size that a limit bounds.

A file can declare far more than it holds: an archive that expands a thousandfold, a
matrix of a billion columns without entries. So readers find out, from headers, what
reading would take, and refuse what exceeds the limit before they begin. The limit is
the environment variable ``MORTARBENCH_MOST_MIB``, in MiB, 2048 unless it is set.
"""

from __future__ import annotations

import gzip
import json
import os
import resource
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from mortarbench.harness.errors import InputError, shortened
from mortarbench.harness.files import reading

VARIABLE = "MORTARBENCH_MOST_MIB"
MOST_MIB = 2048
MIB = 2**20

_PIECE = 2**20  #: bytes that are expanded at once
_LEAST_ROOM = 256 * MIB  #: of a parser, for what it imports and keeps


def most_bytes() -> int:
    """Give the limit of what a data file may take in memory.

    Raises
    ------
    InputError
        When the environment variable is set, and no positive number.

    """
    text = os.environ.get(VARIABLE, str(MOST_MIB))
    try:
        most = int(text)
    except ValueError:
        most = 0
    if most < 1:
        raise InputError(
            f"{VARIABLE} = {shortened(text)!r}; expected a positive number of MiB"
        )
    return most * MIB


def check_size(what: str, size: int) -> None:
    """Refuse what would take more than the limit.

    Raises
    ------
    InputError
        With what it would take, in MiB, and how to raise the limit.

    """
    if size > (most := most_bytes()):
        needed = f"{size // MIB}" if size < 2**60 else "more than 10^12"
        raise InputError(
            f"{what} would take {needed} MiB of memory; expected at most {most // MIB} "
            f"(set {VARIABLE} to allow more)"
        )


@contextmanager
def opened(path: Path, expected: str, *, limited: bool = True) -> Iterator[BinaryIO]:
    """Open a regular file to be read; pipes and devices could give without end.

    expected : what would be right, for messages, e.g. "an npz file"
    limited : whether a file above the limit is refused

    Raises
    ------
    InputError
        When it cannot be opened, or is none of these.

    """
    with reading.opened(path, expected) as file:
        if limited:
            check_size(f"{path}: the file", os.fstat(file.fileno()).st_size)
        yield file


def content(path: Path, expected: str, *, copies: int = 1) -> bytes:
    """Read a file whole; what is compressed by gzip, its name ends in .gz, expanded.

    expected : what would be right, for messages
    copies : of the content that its parser may hold, for the limit

    Raises
    ------
    InputError
        As `opened`; when the content would exceed the limit, or cannot be expanded.

    """
    with opened(path, expected) as file:
        if path.suffix.lower() != ".gz":
            size = os.fstat(file.fileno()).st_size
            check_size(f"{path}: what it says", copies * size)
            return file.read(size)
        try:
            most, size = most_bytes() // copies, 0
            with gzip.GzipFile(fileobj=file) as pieces:
                while piece := pieces.read(_PIECE):  # first count: it costs no memory
                    if (size := size + len(piece)) > most:
                        raise InputError(
                            f"{path}: what it expands to would take more than "
                            f"{most_bytes() // MIB} MiB of memory with its parser; "
                            f"expected less (set {VARIABLE} to allow more)"
                        )
            file.seek(0)
            with gzip.GzipFile(fileobj=file) as whole:
                return whole.read(size)
        except (OSError, EOFError, zlib.error):  # no gzip, damaged, cut off
            raise InputError(
                f"{path}: not a gzip file, or damaged; expected {expected}, compressed"
            ) from None


@contextmanager
def parsing(path: Path, wrong: str, room: int) -> Iterator[None]:
    """Let a library read a file: whatever that raises is the file's fault.

    wrong : what to say of it then
    room : bytes of memory that the library may take beside 256 MiB; the kernel refuses
        more

    Raises
    ------
    InputError
        For every exception but our own, and for a library that warns.

    """
    room += _LEAST_ROOM
    try:
        with warnings.catch_warnings(), _at_most(room):
            warnings.simplefilter("error")
            yield
    except InputError:
        raise
    except MemoryError:
        raise InputError(
            f"{path}: would take more than {room // MIB} MiB of memory, while its size "
            "and its head declare less; expected a file that is not damaged"
        ) from None
    except Exception:  # libraries raise whatever a damaged file leads them to
        raise InputError(f"{path}: {wrong}") from None


@contextmanager
def _at_most(size: int) -> Iterator[None]:
    """Bound what this process may take of address space beyond what it has."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * os.sysconf("SC_PAGE_SIZE") + size
    known = [k for k in (limit, soft, hard) if k != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_AS, (min(known), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def json_object(text: str | bytes) -> dict[str, Any]:
    """Parse a JSON object.

    Raises
    ------
    ValueError
        When it is none, or nested deeper than Python's parser goes.

    """
    try:
        data = json.loads(text)
    except RecursionError:
        raise ValueError("meta is nested too deeply") from None
    if not isinstance(data, dict):
        raise ValueError("meta is no JSON object")
    return data
