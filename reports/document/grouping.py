"""Grouping of items by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

Item = TypeVar("Item")
Name = TypeVar("Name")


def grouped(
    items: Iterable[Item], name: Callable[[Item], Name]
) -> dict[Name, list[Item]]:
    """Group items by name; names and items keep their order."""
    groups: dict[Name, list[Item]] = {}
    for item in items:
        groups.setdefault(name(item), []).append(item)
    return groups
