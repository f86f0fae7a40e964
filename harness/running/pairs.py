"""How well the time of one solver is known relative to that of another."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.special import stdtrit

COVERAGE = 0.95

#: session and repeat: the solvers of one case and tolerance that have it in common were
#: measured next to each other
Block = tuple[str, int]
Key = TypeVar("Key", Block, int)


class Ratio(NamedTuple):
    """A ratio of times and its interval, of 95 % where nothing else is said."""

    value: float
    low: float
    high: float
    pairs: int  #: of what the interval is made: pairs, or the fewer of two samples
    paired: bool = True  #: within blocks; else of two samples from different sessions

    @property
    def half_width(self) -> float:
        """Relative: the interval is value·(1 + half_width)^±1."""
        return float(np.sqrt(self.high / self.low) - 1)


def paired_ratio(a: Mapping[Key, float], b: Mapping[Key, float]) -> Ratio | None:
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
    half = _student(n - 1) * logs.std(ddof=1) / np.sqrt(n)
    low, value, high = np.exp(logs.mean() + np.array([-half, 0.0, half]))
    return Ratio(float(value), float(low), float(high), n)


def unpaired_ratio(
    a: Iterable[float], b: Iterable[float], coverage: float = COVERAGE
) -> Ratio | None:
    """Compare two samples of times that have no block in common.

    The means of their logarithms are compared, by Welch's interval [1]_: nothing
    cancels, and what changed from one session to the other as a whole is not in it.
    None below two values of either.

    a, b : seconds
    coverage : of the interval

    References
    ----------
    .. [1] B. L. Welch, The generalization of 'Student's' problem when several different
       population variances are involved, Biometrika 34 (1947) 28-35

    """
    x, y = (np.log([*values]) for values in (a, b))
    n, m = x.size, y.size
    if min(n, m) < 2:
        return None
    of_x, of_y = x.var(ddof=1) / n, y.var(ddof=1) / m
    freedom = n + m - 2.0
    if (error := of_x + of_y) > 0:
        freedom = error**2 / (of_x**2 / (n - 1) + of_y**2 / (m - 1))
    half = _student(float(freedom), coverage) * np.sqrt(error)
    low, value, high = np.exp(x.mean() - y.mean() + np.array([-half, 0.0, half]))
    return Ratio(float(value), float(low), float(high), min(n, m), paired=False)


def ratio_of(a: Mapping[Block, float], b: Mapping[Block, float]) -> Ratio | None:
    """Compare by the blocks that both were measured in, or else as two samples.

    a, b : seconds by block; None where neither comparison has an interval
    """
    return paired_ratio(a, b) or unpaired_ratio(a.values(), b.values())


@cache
def _student(freedom: float, coverage: float = COVERAGE) -> float:
    """Half-width of an interval in errors of what it is of."""
    return float(stdtrit(freedom, 0.5 + coverage / 2))


def largest_half_width(times: Mapping[str, Mapping[Block, float]]) -> float | None:
    """Return the half-width of the least certain ratio to the fastest solver.

    times : seconds by solver and block; None with fewer than two solvers, infinity
        where a ratio has no interval yet
    """
    if len(times) < 2:
        return None
    medians = {s: float(np.median(list(of.values()))) for s, of in times.items()}
    fastest = min(medians, key=lambda s: medians[s])
    ratios = [ratio_of(of, times[fastest]) for s, of in times.items() if s != fastest]
    return max(np.inf if r is None else r.half_width for r in ratios)
