"""Medians of the measured samples, and what is extrapolated from them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from mortarbench.harness.files.experiment import Row
from mortarbench.reports.statistics.intervals import Interval, median_interval

Key = tuple[Any, ...]


class Point(NamedTuple):
    """One point of a curve: a size and a time in seconds with its interval."""

    x: float
    time: Interval


class Fit(NamedTuple):
    """t = c·xᵖ with p given; c between the extremes over the points it rests on."""

    power: int
    c: float
    low: float
    high: float
    since: float  #: the smallest size it rests on
    until: float  #: the largest


def medians(rows: Iterable[Row], keys: Sequence[str]) -> dict[Key, Interval]:
    """Group rows by the values of `keys` and take the median of their seconds.

    Parts that are not among the keys are summed within each repeat.
    """
    sums: dict[Key, dict[Any, float]] = {}
    for row in rows:
        repeats = sums.setdefault(tuple(row[k] for k in keys), {})
        repeat = row["repeat"]
        repeats[repeat] = repeats.get(repeat, 0.0) + float(row["seconds"])
    return {key: median_interval(list(s.values())) for key, s in sums.items()}


def curve(rows: Iterable[Row], x: str, **where: Any) -> list[Point]:
    """Medians against the column `x` of those rows that have the values in `where`.

    A value may be a tuple: any of these; their parts are summed.
    """
    kept = [r for r in rows if all(_is(r[k], v) for k, v in where.items())]
    found = medians(kept, [x])
    return [Point(float(key), time) for (key,), time in sorted(found.items())]


def _is(value: Any, wanted: Any) -> bool:
    return bool(value in wanted if isinstance(wanted, tuple) else value == wanted)


def fit(points: Sequence[Point], power: int) -> Fit:
    """Fit c by least squares on logarithms to the upper half of the sizes."""
    upper = points[len(points) // 2 :]
    ratios = [p.time.value / p.x**power for p in upper]
    c = float(np.exp(np.mean(np.log(ratios))))
    return Fit(power, c, min(ratios), max(ratios), upper[0].x, upper[-1].x)
