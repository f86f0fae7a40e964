"""Which measurements the points of a figure show: what matplotlib has no place for."""

from __future__ import annotations

from collections.abc import Sequence
from weakref import WeakKeyDictionary

from matplotlib.artist import Artist

from harness import Record

Runs = Sequence[Record]

_BEHIND: WeakKeyDictionary[Artist, tuple[Runs, ...]] = WeakKeyDictionary()


def behind(artist: Artist, points: Sequence[Runs]) -> None:
    """Remember the measurements of each point of a line, or of all its points (one)."""
    _BEHIND[artist] = tuple(points)


def measured(artist: Artist) -> tuple[Runs, ...]:
    """Recall them; empty if there are none."""
    return _BEHIND.get(artist, ())
