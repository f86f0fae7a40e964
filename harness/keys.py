"""Keys of families and options of solvers: types, ranges and help texts.

A key is a field of a frozen dataclass. Its annotation contains its type, its range and
a help text; this module is the only one that reads these annotations::

    n: Annotated[int, Range(1, 100), "cells along the side"] = 8
    law: Annotated[Literal["hertz", "rough"], "law of contact"] = "hertz"

Fields with ``field(compare=False)`` are not keys. A key with the default `DERIVED`
takes a value that follows from other keys; see `mortarbench.harness.plugin.Family`.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from types import NoneType
from typing import (
    Annotated,
    Any,
    Literal,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from mortarbench.harness.checked import has_control
from mortarbench.harness.errors import InputError, shown

Value = int | float | str  #: value of a key in a case name
DERIVED: Any = None  #: default of a key whose value follows from other keys

_INTEGER = re.compile(r"[+-]?[0-9]+")
_REAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_INTEGER_LIMIT = 2**63  #: smallest positive integer that does not fit in 64 bits
_TYPE_NAMES = {
    int: "an integer, such as 4",
    float: "a finite number, such as 0.5",
    str: "nonempty text without control characters",
}


@dataclass(frozen=True)
class Range:
    """Inclusive bounds of the values of a key; as text, such as "at least 1"."""

    least: float = -math.inf
    most: float = math.inf

    def __contains__(self, value: float) -> bool:
        return self.least <= value <= self.most

    def require(self, name: str, value: float) -> None:
        """Raise InputError unless a value is in the range.

        name : key of the value, for the message
        """
        if value not in self:
            is_positive = value <= 0 < self.least < 1
            expected = "positive" if is_positive else str(self)
            raise InputError(f"{name}={value} must be {expected}")

    def __str__(self) -> str:
        if self.most == math.inf:
            return f"at least {self.least:g}"
        if self.least == -math.inf:
            return f"at most {self.most:g}"
        return f"between {self.least:g} and {self.most:g}"


@dataclass(frozen=True, kw_only=True)
class Key:
    """Type, default, allowed values and help text of one key of a family."""

    name: str
    kind: type  #: int, float or str
    default: Value | None  #: None if the value follows from other keys
    choices: tuple[Value, ...] = ()  #: allowed values; empty if the key is not a choice
    range: Range = Range()
    help: str = ""

    def __str__(self) -> str:
        values = " | ".join(map(str, self.choices))
        if self.range != Range():
            values = f"{self.kind.__name__}, {self.range}"
        return f"{values or self.kind.__name__}: {self.help}".removesuffix(": ")

    def typed(self, value: object, *, is_text: bool = False) -> Value:
        """Return a value with the type of the key; an integer may become a float.

        is_text : True to convert the text of a number

        Raises
        ------
        InputError
            If the value has another type.

        """
        if is_text and self.kind is not str and isinstance(value, str):
            value = _number(value, self.kind)
        free = self.name == "path"  # / and = are separators in other values of a name
        match value:
            case str() if self.kind is str and value:
                if (free or not set("/=") & set(value)) and not has_control(value):
                    return value
            case bool():
                pass
            case int() if self.kind is int and abs(value) < _INTEGER_LIMIT:
                return value
            case int() | float() if (
                self.kind is float and abs(value) <= sys.float_info.max
            ):
                # −0.0 becomes 0.0, since equal values need equal names
                return float(value) + 0.0
        expected = _TYPE_NAMES[self.kind]
        if self.kind is str and not free:
            expected += ", / and ="
        elif self.kind is int and type(value) is int:
            expected = "an integer of at most 64 bits"
        raise InputError(f"{self.name}={shown(value)}; expected {expected}")

    def check(self, value: Any) -> None:
        """Raise InputError unless the value is in the range and among the choices."""
        if self.choices and value not in self.choices:
            expected = " or ".join(map(repr, self.choices))
            raise InputError(f"{self.name}={value!r} is unknown, expected {expected}")
        if self.kind is not str:
            self.range.require(self.name, value)


@cache
def keys_of(family: type) -> Mapping[str, Key]:
    """Return the keys of a class of families, in the order of its fields.

    Raises
    ------
    InputError
        If a field has no default, or is not an int, a float, a string or a Literal.

    """
    hints, keys = get_type_hints(family, include_extras=True), {}
    for field in fields(family):
        if not field.compare:
            continue
        hint = hints[field.name]
        annotation, *extras = (
            get_args(hint) if get_origin(hint) is Annotated else (hint,)
        )
        choices = get_args(annotation) if get_origin(annotation) is Literal else ()
        kinds = {type(value) for value in choices} or {annotation}
        if len(kinds) != 1 or not kinds <= _TYPE_NAMES.keys():
            raise InputError(
                f"key {field.name} is annotated as {annotation}; expected int, float, "
                "str or a Literal of one of these types"
            )
        if not isinstance(field.default, (*_TYPE_NAMES, NoneType)):
            raise InputError(f"key {field.name} has no default; expected a value")
        keys[field.name] = Key(
            name=field.name,
            kind=kinds.pop(),
            default=cast(Value | None, field.default),
            choices=choices,
            range=next((x for x in extras if isinstance(x, Range)), Range()),
            help=next((x for x in extras if isinstance(x, str)), ""),
        )
    return keys


def _number(text: str, kind: type) -> object:
    """Convert a text to a finite number; return any other text unchanged."""
    if not (_INTEGER if kind is int else _REAL).fullmatch(text):
        return text  # int and float would also accept 1_0 and digits of other scripts
    try:
        number = kind(text)
        return number if math.isfinite(number) else text
    except (ValueError, OverflowError):
        return text
