"""Timing of methods by alternating runs in one process.

Alternation distributes slow changes of the machine's speed evenly over all methods.
Every measured time is stored; reports compute medians and intervals.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter

Laps = Mapping[str, float]  #: mapping from the name of a timed part to its time in s
Contestant = Callable[[], Laps]  #: method that runs once and returns its times


@dataclass(frozen=True, kw_only=True)
class Rounds:
    """Number of rounds: `most`, or fewer (at least `least`) if rounds take too long."""

    most: int
    least: int = 5
    #: time in s after which no further round starts if `least` rounds are complete
    seconds: float = 20.0


class Stopwatch:
    """Stopwatch that accumulates the time of each named part, s."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = perf_counter()

    def lap(self, part: str) -> None:
        """Add the time since the last lap to `part`."""
        now = perf_counter()
        self.laps[part] = self.laps.get(part, 0.0) + now - self._last
        self._last = now


def timed_as_one(work: Callable[[], object], part: str = "all") -> Contestant:
    """Return a contestant that times `work` as a single part."""

    def timed() -> Laps:
        start = perf_counter()
        work()
        return {part: perf_counter() - start}

    return timed


def race(
    contestants: Mapping[str, Contestant], rounds: Rounds, *, warm: bool = True
) -> list[dict[str, str | int | float]]:
    """Time methods alternately; return one row per method, timed part and repeat.

    warm : True to run each method once before timing, to exclude the effect of cold
        caches

    """
    if warm:
        for contestant in contestants.values():
            contestant()
    rows: list[dict[str, str | int | float]] = []
    with _no_collection():
        start = perf_counter()
        for repeat in range(rounds.most):
            if repeat >= rounds.least and perf_counter() - start > rounds.seconds:
                break
            for method, contestant in contestants.items():
                rows += [
                    {"method": method, "part": part, "repeat": repeat, "seconds": s}
                    for part, s in contestant().items()
                ]
    return rows


@contextmanager
def _no_collection() -> Iterator[None]:
    """Disable Python's garbage collector within the context."""
    enabled = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
