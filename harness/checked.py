"""Plain data that a user wrote, checked: what is wrong, where, what would be right.

The data are of a file, or arguments of a Python program. All functions raise
`InputError`; `where` names the value as the user knows it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mortarbench.harness.errors import InputError, shown, unknown

MOST_REPEATS = 1_000_000  #: of anything


@contextmanager
def located(where: str) -> Iterator[None]:
    """Put the place in the user's input before what is wrong there."""
    try:
        yield
    except InputError as e:
        raise InputError(f"{where}: {e}") from None


def only_keys(table: Mapping[str, Any], known: Sequence[str]) -> None:
    """Refuse a key that means nothing to us."""
    for key in table:
        if key not in known:
            raise unknown("key", key, known)


def at_least_one(where: str, value: object, most: int = MOST_REPEATS) -> int:
    """Take a positive integer up to `most`; neither 2.0 nor true is one."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise InputError(f"{where} = {shown(value)}; expected an integer of at least 1")
    if value > most:
        raise InputError(
            f"{where} = {shown(value)}; expected an integer of at most {most}"
        )
    return value


def positive(where: str, value: Any) -> float:
    """Take a positive finite number."""
    if not is_number(value) or not 0 < value <= sys.float_info.max:
        raise InputError(f"{where} = {shown(value)}; expected a positive number")
    return float(value)


def is_number(value: object) -> bool:
    """Whether `value` is a number; a bool is none."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def text(where: str, value: object) -> str:
    """Take a text that is not empty."""
    if not isinstance(value, str) or not value:
        raise InputError(f"{where} = {shown(value)}; expected a text, not empty")
    if has_control(value):
        raise InputError(
            f"{where} = {shown(value)}; expected a text without control characters"
        )
    return value


def has_control(text: str) -> bool:
    """Whether a text holds a control character, which no name and no path should."""
    return any(c < " " or c == "\x7f" for c in text)


def any_list(where: str, value: object) -> list[Any]:
    """Take a list, empty or not."""
    if not isinstance(value, list):
        raise InputError(f"{where} = {shown(value)}; expected a list")
    return value


def filled_list(where: str, value: object) -> list[Any]:
    """Take a list with entries."""
    entries = any_list(where, value)
    if not entries:
        raise InputError(f"{where} is empty; expected at least one entry")
    return entries


def table(where: str, value: object, *, instead: str = "a table") -> dict[str, Any]:
    """Take a table."""
    if not isinstance(value, dict):
        raise InputError(f"{where} = {shown(value)}; expected {instead}")
    return value


def path(where: str, value: object) -> Path:
    """Take a path, as a text or a path of Python, that a file system can have."""
    if not isinstance(value, str | os.PathLike) or not isinstance(
        text := os.fspath(value), str
    ):
        raise InputError(f"{where} = {shown(value)}; expected a path, a str or a Path")
    if not text:
        raise InputError(f"{where} is empty; expected a path")
    try:
        os.stat(text)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError) as e:  # a NUL or a lone surrogate
        why = e.strerror if isinstance(e, OSError) else "no name of a file"
        raise InputError(f"{where} = {shown(text)}: {why}; expected a path") from None
    return Path(text)


def texts(where: str, value: object) -> tuple[str, ...]:
    """Take several texts; one by itself is a list of its characters by mistake."""
    if isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping):
        found = tuple(value)
        if all(isinstance(each, str) for each in found):
            return found
    raise InputError(f"{where} = {shown(value)}; expected a list of texts")


def flag(where: str, value: object) -> bool:
    """Take True or False; 0 and 1 stand for them."""
    if not isinstance(value, int) or value not in (0, 1):
        raise InputError(f"{where} = {shown(value)}; expected True or False")
    return bool(value)


def function(where: str, value: object) -> None:
    """Refuse what cannot be called."""
    if not callable(value):
        raise InputError(f"{where} = {shown(value)}; expected a function")
