"""The clock of the experiments: contestants take turns in one process.

Taking turns makes a drift of the machine hit all alike. Every sample is kept; what is
made of them (medians, intervals) is the business of reports.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter

Laps = Mapping[str, float]  #: part of the work → seconds
Contestant = Callable[[], Laps]


@dataclass(frozen=True, kw_only=True)
class Rounds:
    """How often to measure: `most` times, fewer where that takes too long."""

    most: int
    least: int = 5
    seconds: float = 20.0  #: after which no round begins, once there are `least`


class Stopwatch:
    """Sums the seconds since the last lap under the names of the parts."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = perf_counter()

    def lap(self, part: str) -> None:
        """Book the time since the last lap on `part`."""
        now = perf_counter()
        self.laps[part] = self.laps.get(part, 0.0) + now - self._last
        self._last = now


def whole(work: Callable[[], object], part: str = "all") -> Contestant:
    """Time all of `work` as one part."""

    def timed() -> Laps:
        start = perf_counter()
        work()
        return {part: perf_counter() - start}

    return timed


def race(
    contestants: Mapping[str, Contestant], rounds: Rounds, *, warm: bool = True
) -> list[dict[str, str | int | float]]:
    """Measure in turn; one row (method, part, repeat, seconds) for each lap.

    warm : call each once before, so that caches and compilation are not measured

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
    """Keep Python's garbage collector from running within."""
    enabled = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
