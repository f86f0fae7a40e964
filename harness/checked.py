"""Checks of plain data from users: entries of files, and arguments of functions.

A failed check raises `InputError`. The argument `where` of a check is the name of the
value in the error message, such as a key of a file.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from numbers import Real
from pathlib import Path
from typing import Any

from mortarbench.harness.errors import InputError, shown, unknown


@contextmanager
def located(where: str) -> Iterator[None]:
    """Prefix the message of an `InputError` from the block with `where`."""
    try:
        yield
    except InputError as e:
        raise InputError(f"{where}: {e}") from None


def only_keys(table: Mapping[str, Any], known: Sequence[str]) -> None:
    """Raise `InputError` if a key of `table` is not in `known`."""
    for key in table:
        if key not in known:
            raise unknown("key", key, known)


def positive(where: str, value: Any) -> float:
    """Check that `value` is a positive finite number, and return it as a float."""
    if not is_number(value) or not 0 < value <= sys.float_info.max:
        raise InputError(f"{where} = {shown(value)}; expected a positive number")
    return float(value)


def tolerance(value: Any) -> float:
    """Check that a tolerance `value` is a number between 0 and 1; return a float."""
    if (
        not isinstance(value, Real)
        or isinstance(value, bool)
        or not 0 < float(value) < 1
    ):
        raise InputError(f"tol = {shown(value)}; expected a number between 0 and 1")
    return float(value)


def is_number(value: object) -> bool:
    """Return True if `value` is an int or a float, but not a bool."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def text(where: str, value: object) -> str:
    """Check that `value` is a nonempty string without control characters; return it."""
    if not isinstance(value, str) or not value:
        raise InputError(f"{where} = {shown(value)}; expected a nonempty string")
    if has_control(value):
        raise InputError(
            f"{where} = {shown(value)}; expected a string without control characters"
        )
    return value


def has_control(text: str) -> bool:
    """Return True if `text` contains an ASCII control character."""
    return any(c < " " or c == "\x7f" for c in text)


def any_list(where: str, value: object) -> list[Any]:
    """Check that `value` is a list, which may be empty, and return it."""
    if not isinstance(value, list):
        raise InputError(f"{where} = {shown(value)}; expected a list")
    return value


def filled_list(where: str, value: object) -> list[Any]:
    """Check that `value` is a nonempty list, and return it."""
    entries = any_list(where, value)
    if not entries:
        raise InputError(f"{where} is empty; expected at least one entry")
    return entries


def table(where: str, value: object) -> dict[str, Any]:
    """Check that `value` is a table (dict), and return it."""
    if not isinstance(value, dict):
        raise InputError(f"{where} = {shown(value)}; expected a table")
    return value


def path(where: str, value: object) -> Path:
    """Check that `value` is a str or PathLike, and return it as a Path.

    The file need not exist, but the operating system must accept the path.
    """
    if not isinstance(value, str | os.PathLike) or not isinstance(
        text := os.fspath(value), str
    ):
        raise InputError(f"{where} = {shown(value)}; expected a path (str or Path)")
    if not text:
        raise InputError(f"{where} is empty; expected a path")
    try:
        os.stat(text)
    except (FileNotFoundError, NotADirectoryError):
        pass
    # NUL characters and lone surrogates cause a ValueError
    except (OSError, ValueError) as e:
        why = e.strerror if isinstance(e, OSError) else "not a valid file name"
        raise InputError(f"{where} = {shown(text)}: {why}; expected a path") from None
    return Path(text)


def output_file(path_: str | os.PathLike[str], suffixes: Sequence[str]) -> Path:
    """Check that a path is a valid name of an output file, and return the path.

    Raises
    ------
    InputError
        If the suffix is not in `suffixes`, the path is a folder, or the folder that
        would contain the file is missing.

    """
    file = path("path", path_)
    if file.suffix not in suffixes:
        raise InputError(
            f"{file}: unknown format {file.suffix!r}; expected {' or '.join(suffixes)}"
        )
    if file.is_dir():
        raise InputError(f"{file} is a folder; expected a file")
    if not file.parent.is_dir():
        raise InputError(
            f"{file}: the folder {file.parent} does not exist; expected "
            "an existing folder"
        )
    return file


def result_folder(where: str, value: object) -> Path:
    """Check that `value` is the path of a folder, and return it as a Path."""
    folder = path(where, value)
    if not folder.is_dir():
        what = "a file" if folder.exists() else "no such folder"
        raise InputError(f"{folder}: {what}; expected a result folder of `run`")
    return folder


def texts(where: str, value: object) -> tuple[str, ...]:
    """Check that `value` is an iterable of strings, and return it as a tuple.

    A single string is refused, although it is an iterable of its characters.
    """
    if isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping):
        entries = tuple(value)
        if all(isinstance(each, str) for each in entries):
            return entries
    raise InputError(f"{where} = {shown(value)}; expected a list of strings")


def names(where: str, kind: str, value: object, known: Sequence[str]) -> list[str]:
    """Check that `value` is an iterable of known names, and return them in a list."""
    listed = texts(where, value)
    for name in listed:
        if name not in known:
            raise unknown(kind, name, known, where=where)
    return [*listed]
