"""How well the time of one solver is known relative to that of another."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

COVERAGE = 0.95


class Ratio(NamedTuple):
    """A ratio of times and its 95 % interval."""

    value: float
    low: float
    high: float
    pairs: int

    @property
    def half_width(self) -> float:
        """Relative: the interval is value·(1 + half_width)^±1."""
        return float(np.sqrt(self.high / self.low) - 1)


def paired_ratio(a: Mapping[int, float], b: Mapping[int, float]) -> Ratio | None:
    """Compare two solvers by the blocks that both were measured in.

    The logarithms of the ratios within blocks are averaged; their interval is
    Student's. What slows a whole block down cancels. None below two blocks.

    a, b : seconds by block
    """
    blocks = sorted(a.keys() & b.keys())
    n = len(blocks)
    if n < 2:
        return None
    logs = np.log([a[i] / b[i] for i in blocks])
    half = _student(n) * logs.std(ddof=1) / np.sqrt(n)
    low, value, high = np.exp(logs.mean() + np.array([-half, 0.0, half]))
    return Ratio(float(value), float(low), float(high), n)


@cache
def _student(n: int) -> float:
    """Half-width of the interval from n values, in errors of their mean."""
    return float(stdtrit(n - 1, 0.5 + COVERAGE / 2))


def widest(times: Mapping[str, Mapping[int, float]]) -> float | None:
    """Return the half-width of the least certain ratio to the fastest solver.

    times : seconds by solver and block; None with fewer than two solvers, infinity
        where a ratio has no interval yet
    """
    if len(times) < 2:
        return None
    medians = {s: float(np.median(list(of.values()))) for s, of in times.items()}
    fastest = min(medians, key=lambda s: medians[s])
    ratios = [
        paired_ratio(of, times[fastest]) for s, of in times.items() if s != fastest
    ]
    return max(np.inf if r is None else r.half_width for r in ratios)
