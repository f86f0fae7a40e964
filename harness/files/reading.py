"""Reading of files from untrusted sources, within limits.

A small file can declare huge data, for instance an archive that expands a thousandfold,
or a matrix with a billion columns and no entries. Readers therefore compute the
required memory from the headers. If the required memory exceeds the limit, readers
refuse the file before they read the data. The environment variable
``MORTARBENCH_MOST_MIB`` sets the limit in MiB; the default is 2048.

A file must be regular, since a device or a pipe may never end. A text must be UTF-8,
must not exceed a limit, and must not be nested too deeply. All functions raise an
`InputError` that states where the error is and what was expected.
"""

from __future__ import annotations

import os
import re
import stat
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import msgspec

from mortarbench.harness.checked import located
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.durable import FULL
from mortarbench.harness.limits import limit_of

MAX_TOML_MIB = 1  #: limit for TOML files; a file of this size takes 1 s to parse
MAX_JSON_MIB = 64  #: limit for other text files
MAX_LEVELS = 50  #: largest depth of nesting
#: A dotted TOML key with more than `MAX_LEVELS` components. Such a key is rejected
#: before parsing, since the parser's time is quadratic in the number of components.
_LONG_KEY = re.compile(
    r"""(?<![\w"'.-])[\w"'-]++(?:[ \t]*+\.[ \t]*+[\w"'-]++)"""
    f"{{{MAX_LEVELS}}}"
)

VARIABLE = "MORTARBENCH_MOST_MIB"
DEFAULT_MIB = 2048
MIB = 2**20  #: number of bytes in a mebibyte


def max_bytes() -> int:
    """Return the memory limit for a data file, in bytes; see `limit_of` for errors."""
    return int(limit_of(VARIABLE, DEFAULT_MIB) * MIB)


def check_size(what: str, size: int) -> None:
    """Check that data of `size` bytes do not exceed the memory limit.

    what : subject of the error message

    Raises
    ------
    InputError
        If the data exceed the limit; the message states the required memory in MiB, and
        how to raise the limit.

    """
    if size > (most := max_bytes()):
        # `//` rounds down, so a size just above the limit would be printed as the limit
        needed = f"{max(size // MIB, most // MIB + 1)}"
        needed = needed if size < 2**60 else "more than 10^12"
        raise InputError(
            f"{what} would take {needed} MiB of memory; expected at most {most // MIB} "
            f"(set {VARIABLE} to allow more)"
        )


@contextmanager
def opened(path: Path, expected: str = "a file") -> Iterator[BinaryIO]:
    """Open a regular file for reading; pipes and devices are refused.

    expected : description of the file, for messages, e.g. "an npz file"

    Raises
    ------
    InputError
        If the file cannot be opened, is not a regular file, or exceeds the limit.

    """
    try:
        # without blocking, in case the file is a pipe
        fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as e:  # a NUL character in the name raises ValueError
        why = e.strerror if isinstance(e, OSError) else "not a valid file name"
        raise InputError(f"{path}: {why}; expected {expected}") from None
    status = os.fstat(fd)
    if not stat.S_ISREG(status.st_mode):
        os.close(fd)
        wrong = "a folder" if stat.S_ISDIR(status.st_mode) else "a device or a pipe"
        raise InputError(f"{path}: {wrong}; expected {expected}")
    with os.fdopen(fd, "rb") as file:
        try:
            check_size(f"{path}: the file", status.st_size)
            yield file
        # Errors with a file name, or about a full disk, concern other files that the
        # block opens or writes.
        except OSError as e:
            if e.errno in (None, *FULL) or e.filename is not None:
                raise
            raise InputError(f"{path}: {e.strerror}; expected {expected}") from None


def read_text(
    path: Path, expected: str = "a text file", most: int = MAX_JSON_MIB
) -> str:
    """Read a text file.

    expected : description of the file, for messages
    most : limit of the size in MiB
    """
    with opened(path, expected) as file:
        data = file.read(most * 2**20 + 1)
    if len(data) > most * 2**20:
        raise InputError(f"{path}: larger than {most} MiB; expected {expected}")
    try:
        return data.decode()
    except UnicodeDecodeError:
        raise InputError(f"{path}: not UTF-8; expected {expected}") from None


def read_toml(path: Path) -> dict[str, Any]:
    """Read and parse a TOML file."""
    text = read_text(path, "a TOML file", MAX_TOML_MIB)
    with located(f"{path}"):
        return toml(text)


def toml(text: str) -> dict[str, Any]:
    """Parse a TOML document."""
    try:
        if _LONG_KEY.search(text):
            raise RecursionError
        table = tomllib.loads(text)
        _refuse_deep(table)
    # message such as "Expected … (at line 3, column 5)"
    except tomllib.TOMLDecodeError as e:
        what, _, place = str(e).removesuffix(")").rpartition(" (at ")
        raise InputError(f"{place}: {what}") from None
    except RecursionError:
        raise _too_deep() from None
    except ValueError as e:  # Python limits the number of digits of an integer
        raise InputError(str(e)) from None
    return table


def read_json(path: Path, expected: str = "a JSON file") -> Any:
    """Read and parse a JSON file; `expected` describes it in messages."""
    text = read_text(path, expected, MAX_JSON_MIB)
    try:
        data = msgspec.json.decode(text)
        _refuse_deep(data)
    except RecursionError:
        raise InputError(f"{path}: {_too_deep()}") from None
    except msgspec.DecodeError as e:
        raise InputError(f"{path}: malformed: {e}; expected {expected}") from None
    return data


def _refuse_deep(data: object) -> None:
    """Raise RecursionError if data are nested more than `MAX_LEVELS` levels deep."""
    level = [data]
    for _ in range(MAX_LEVELS + 1):
        level = [
            inner
            for outer in level
            if isinstance(outer, dict | list)
            for inner in (outer.values() if isinstance(outer, dict) else outer)
        ]
        if not level:
            return
    raise RecursionError


def _too_deep() -> InputError:
    return InputError(f"nested too deeply; expected at most {MAX_LEVELS} levels")
