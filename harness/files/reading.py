"""Text files that somebody else wrote, read within bounds.

What is read is a regular file (a device or a pipe could last for ever), of the size
that it declares (files of /proc declare none), not larger than a limit that users can
raise, UTF-8, and nested as deeply as data are. All functions raise `InputError`, with
the place and what would be right.
"""

from __future__ import annotations

import json
import os
import re
import stat
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from math import isinf
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

from mortarbench.harness.errors import InputError
from mortarbench.harness.files.durable import FULL

VARIABLE = "MORTARBENCH_TEXT_MIB"  #: the largest text file that is read
MOST_TOML = 1.0  #: MiB, where the variable is not set: a second to parse
MOST_JSON = 64.0  #: MiB
MOST_LEVELS = 50  #: of what is nested

#: a TOML key of more parts than levels are allowed, found before it is parsed: the
#: parser takes a time that grows with the square of their number
_LONG_KEY = re.compile(
    r"""(?<![\w"'.-])[\w"'-]++(?:[ \t]*+\.[ \t]*+[\w"'-]++)"""
    f"{{{MOST_LEVELS}}}"
)


@contextmanager
def opened(path: Path, expected: str = "a file") -> Iterator[BinaryIO]:
    """Open a regular file to be read; pipes and devices could give without end.

    expected : what to say instead of "a file"
    """
    try:
        regular = stat.S_ISREG(path.stat().st_mode)  # to open a device may act on it
        flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC  # a pipe took its place
        fd = os.open(path, flags) if regular else -1
    except (OSError, ValueError) as e:  # a NUL in the name
        why = e.strerror if isinstance(e, OSError) else "no name of a file"
        raise InputError(f"{path}: {why}; expected {expected}") from None
    if not regular or not stat.S_ISREG(os.fstat(fd).st_mode):
        if fd >= 0:
            os.close(fd)
        wrong = "a folder" if path.is_dir() else "a device or a pipe"
        raise InputError(f"{path}: {wrong}; expected {expected}")
    with os.fdopen(fd, "rb") as file:
        try:
            if os.fstat(fd).st_size == 0 and os.pread(fd, 1, 0):
                raise InputError(
                    f"{path}: of no size that it declares, as files of the kernel; "
                    f"expected {expected}"
                )
            yield file
        except OSError as e:  # of reading: others name a file, or tell of a full disk
            if e.errno in (None, *FULL) or e.filename is not None:
                raise
            raise InputError(f"{path}: {e.strerror}; expected {expected}") from None


def read_text(
    path: Path, expected: str = "a text file", most: float = MOST_JSON
) -> str:
    """Read a text file.

    expected : what to say instead of "a text file"
    most : MiB, unless the user set another limit
    """
    limit = _limit(most)
    with opened(path, expected) as file:
        data = file.read(int(limit * 2**20) + 1)
    if len(data) > limit * 2**20:
        raise InputError(
            f"{path}: larger than {limit:g} MiB; expected {expected}, or set "
            f"{VARIABLE} to a higher limit"
        )
    try:
        return data.decode()
    except UnicodeDecodeError:
        raise InputError(f"{path}: not UTF-8; expected {expected}") from None


def read_toml(path: Path, expected: str = "a TOML file") -> dict[str, Any]:
    """Read and parse a TOML file."""
    text = read_text(path, expected, MOST_TOML)
    try:
        return toml(text)
    except InputError as e:
        raise InputError(f"{path}: {e}") from None


def toml(text: str) -> dict[str, Any]:
    """Parse TOML."""
    try:
        if _LONG_KEY.search(text):
            raise RecursionError
        table = tomllib.loads(text)
        _refuse_deep(table)
    except tomllib.TOMLDecodeError as e:  # "Expected … (at line 3, column 5)"
        what, _, place = str(e).removesuffix(")").rpartition(" (at ")
        raise InputError(f"{place}: {what}") from None
    except RecursionError:
        raise _too_deep() from None
    except ValueError:  # Python's own limit
        raise InputError(
            "an integer with too many digits; expected at most "
            f"{sys.get_int_max_str_digits()}"
        ) from None
    return table


def read_json(path: Path, expected: str = "a JSON file") -> Any:
    """Read and parse a JSON file."""
    text = read_text(path, expected, MOST_JSON)
    try:
        data = json.loads(
            text, parse_constant=_no_constant, parse_int=_integer, parse_float=_number
        )
        _refuse_deep(data)
    except json.JSONDecodeError as e:
        raise InputError(
            f"{path}: malformed: {e.msg} at line {e.lineno}, column {e.colno}; "
            f"expected {expected}"
        ) from None
    except RecursionError:
        raise InputError(f"{path}: {_too_deep()}") from None
    except ValueError as e:
        raise InputError(f"{path}: malformed: {e}; expected {expected}") from None
    return data


def _refuse_deep(data: object) -> None:
    """Refuse what is nested too deeply for what works on it step by step."""
    level = [data]
    for _ in range(MOST_LEVELS + 1):
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
    return InputError(f"nested too deeply; expected at most {MOST_LEVELS} levels")


def _no_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number in JSON")


def _integer(text: str) -> int:
    _number(text)
    return int(text)


def _number(text: str) -> float:
    if isinf(value := float(text)):
        raise ValueError(f"{text[:20]}… is beyond the range of a double")
    return value


def _limit(most: float) -> float:
    """Give the limit in force, MiB."""
    text = os.environ.get(VARIABLE)
    if text is None:
        return most
    try:
        limit = float(text)
    except ValueError:
        limit = 0.0
    if not 0 < limit < 2**20:
        raise InputError(
            f"{VARIABLE} = {text!r}; expected a number of MiB, such as 100"
        )
    return limit
