"""Description of the differences between two environments."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from mortarbench.harness.errors import shortened, some

#: tuple of dotted key, value before the change, and value after the change
Difference = tuple[str, Any, Any]

_MAX_VALUE_CHARACTERS = 48


def in_words(changes: Iterable[Difference], one: str, other: str) -> str:
    """Describe the first few differences, and count the remaining ones.

    changes : differences between two environments
    one, other : words for the two environments, such as "then" and "now"

    >>> in_words([("machine.kernel", "6.1", "6.2")], "then", "now")
    'machine.kernel: 6.1 then, 6.2 now'

    """
    return some(
        f"{key}: {shortened(str(a), _MAX_VALUE_CHARACTERS)} {one}, "
        f"{shortened(str(b), _MAX_VALUE_CHARACTERS)} {other}"
        for key, a, b in changes
    )
