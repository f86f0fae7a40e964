"""Checks of plain data from users: entries of files, and arguments in Python.

All functions raise `InputError`; `where` is the user's name for the value.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mortarbench.harness.errors import InputError, shown, unknown

MAX_COUNT = 1_000_000  #: default limit of an integer


@contextmanager
def located(where: str) -> Iterator[None]:
    """Prefix the messages of errors in the block with a place in the input."""
    try:
        yield
    except InputError as e:
        raise InputError(f"{where}: {e}") from None


def only_keys(table: Mapping[str, Any], known: Sequence[str]) -> None:
    """Raise if a key of `table` is not in `known`."""
    for key in table:
        if key not in known:
            raise unknown("key", key, known)


def at_least_one(where: str, value: object, most: int = MAX_COUNT) -> int:
    """Return a positive integer up to `most`; 2.0 and True are refused."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise InputError(f"{where} = {shown(value)}; expected an integer of at least 1")
    if value > most:
        raise InputError(
            f"{where} = {shown(value)}; expected an integer of at most {most}"
        )
    return value


def positive(where: str, value: Any) -> float:
    """Return a positive finite number as a float."""
    if not is_number(value) or not 0 < value <= sys.float_info.max:
        raise InputError(f"{where} = {shown(value)}; expected a positive number")
    return float(value)


def is_number(value: object) -> bool:
    """Return True for an int or a float, False for a bool."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def text(where: str, value: object) -> str:
    """Return a nonempty string without control characters."""
    if not isinstance(value, str) or not value:
        raise InputError(f"{where} = {shown(value)}; expected a nonempty string")
    if has_control(value):
        raise InputError(
            f"{where} = {shown(value)}; expected a string without control characters"
        )
    return value


def has_control(text: str) -> bool:
    """Return True if a text contains a control character."""
    return any(c < " " or c == "\x7f" for c in text)


def any_list(where: str, value: object) -> list[Any]:
    """Return a list, empty or not."""
    if not isinstance(value, list):
        raise InputError(f"{where} = {shown(value)}; expected a list")
    return value


def filled_list(where: str, value: object) -> list[Any]:
    """Return a nonempty list."""
    entries = any_list(where, value)
    if not entries:
        raise InputError(f"{where} is empty; expected at least one entry")
    return entries


def table(where: str, value: object, *, instead: str = "a table") -> dict[str, Any]:
    """Return a table; raise for other values.

    instead : description of the expected value for the error message
    """
    if not isinstance(value, dict):
        raise InputError(f"{where} = {shown(value)}; expected {instead}")
    return value


def path(where: str, value: object) -> Path:
    """Return a str or PathLike as a Path, which need not exist; refuse invalid ones."""
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
    except (OSError, ValueError) as e:  # ValueError: a NUL or a lone surrogate
        why = e.strerror if isinstance(e, OSError) else "no name of a file"
        raise InputError(f"{where} = {shown(text)}: {why}; expected a path") from None
    return Path(text)


def texts(where: str, value: object) -> tuple[str, ...]:
    """Return a tuple of strings; refuse a single string, which is also a sequence."""
    if isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping):
        entries = tuple(value)
        if all(isinstance(each, str) for each in entries):
            return entries
    raise InputError(f"{where} = {shown(value)}; expected a list of strings")


def flag(where: str, value: object) -> bool:
    """Return True or False; 0 and 1 are accepted."""
    if not isinstance(value, int) or value not in (0, 1):
        raise InputError(f"{where} = {shown(value)}; expected True or False")
    return bool(value)


def function(where: str, value: object) -> None:
    """Raise unless `value` is callable."""
    if not callable(value):
        raise InputError(f"{where} = {shown(value)}; expected a function")
