"""Description of the differences between two environments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from mortarbench.harness.errors import shortened

#: tuple of dotted key, value before the change, and value after the change
Difference = tuple[str, Any, Any]

_MAX_VALUE_CHARACTERS = 48
_MAX_LISTED = 3  #: largest number of differences that are described in words


def in_words(changes: Iterable[Difference], one: str, other: str) -> str:
    """Describe the first few differences, and count the remaining ones.

    changes : differences between two environments
    one, other : words for the two environments, such as "then" and "now"

    >>> in_words([("machine.kernel", "6.1", "6.2")], "then", "now")
    'machine.kernel: 6.1 then, 6.2 now'

    """

    def shown(value: Any) -> str:
        return shortened(str(value), _MAX_VALUE_CHARACTERS)

    texts = [
        f"other {key}"
        if isinstance(a, Mapping | list) or isinstance(b, Mapping | list)
        else f"{key}: {shown(a)} {one}, {shown(b)} {other}"
        for key, a, b in changes
    ]
    rest = [f"and {len(texts) - _MAX_LISTED} more"] * (len(texts) > _MAX_LISTED)
    return "; ".join([*texts[:_MAX_LISTED], *rest])
