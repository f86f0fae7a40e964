"""Checks of the keys of a family, with the one line that says what would be right."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from harness import InputError, Value


def at_least(
    least: int, family: str, params: Mapping[str, Value], keys: Iterable[str]
) -> None:
    """Raise InputError unless each of the integer `keys` is at least `least`."""
    for key in keys:
        if int(params[key]) < least:
            raise InputError(f"{family}: {key}={params[key]} must be at least {least}")


def positive(family: str, params: Mapping[str, Value], keys: Iterable[str]) -> None:
    """Raise InputError unless each of the real `keys` is positive."""
    for key in keys:
        if float(params[key]) <= 0:
            raise InputError(f"{family}: {key}={params[key]} must be positive")


def one_of(
    family: str, params: Mapping[str, Value], known: Mapping[str, tuple[Value, ...]]
) -> None:
    """Raise InputError unless each key of `known` has one of its values."""
    for key, values in known.items():
        if params[key] not in values:
            raise InputError(
                f"{family}: {key}={params[key]!r} is unknown, expected "
                + " or ".join(map(repr, values))
            )


def doubled(params: Mapping[str, Value], *keys: str) -> dict[str, Value]:
    """Return the integer `keys`, numbers of cells, twice as large."""
    return {key: 2 * int(params[key]) for key in keys}
