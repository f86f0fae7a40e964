"""Ratios of the times of two solvers, with confidence intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.special import stdtrit

COVERAGE = 0.95  #: default coverage probability of the confidence intervals

#: Session and repeat that identify a block of measurements. Within a block, all solvers
#: were measured in immediate succession on the same case at the same tolerance.
Block = tuple[str, int]
Key = TypeVar("Key", Block, int)


class Ratio(NamedTuple):
    """Ratio of times with its confidence interval, by default with 95 % coverage."""

    value: float
    low: float  #: lower end of the interval
    high: float  #: upper end of the interval
    #: number of pairs; for samples that are not paired, the size of the smaller sample
    pairs: int
    paired: bool = True  #: False for samples with fewer than two common blocks

    @property
    def half_width(self) -> float:
        """Relative half-width w; the interval is value·(1 + w)^±1."""
        return float(np.sqrt(self.high / self.low) - 1)


def paired_ratio(a: Mapping[Key, float], b: Mapping[Key, float]) -> Ratio | None:
    """Return the geometric mean of the ratios of two solvers' times in common blocks.

    The logarithms of the ratios within blocks are averaged, and the interval follows
    from Student's t distribution. A disturbance that slows down a whole block by the
    same factor cancels in the ratio. If there are fewer than two common blocks, return
    None.

    a, b : times of the two solvers by block, in s

    >>> ratio = paired_ratio({1: 2.0, 2: 4.2, 3: 1.9}, {1: 1.0, 2: 2.0, 3: 1.0})
    >>> round(ratio.value, 2), ratio.pairs
    (2.0, 3)

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
    """Return the ratio of the mean times of two samples, without pairing by blocks.

    The means are geometric, and the interval is Welch's interval [1]_. Disturbances do
    not cancel in this ratio, and the interval does not account for a change of the
    machine between two sessions. If a sample has fewer than two values, return None.

    a, b : times in s
    coverage : coverage probability of the interval

    References
    ----------
    .. [1] B. L. Welch, The generalization of 'Student's' problem when several different
       population variances are involved, Biometrika 34 (1947) 28-35

    """
    x, y = (np.log([*values]) for values in (a, b))
    n, m = x.size, y.size
    if min(n, m) < 2:
        return None
    # squared standard errors of the two means; the sum is the squared standard error of
    # the difference of the means
    x_error, y_error = x.var(ddof=1) / n, y.var(ddof=1) / m
    freedom = n + m - 2.0
    if (error := x_error + y_error) > 0:  # Welch-Satterthwaite degrees of freedom
        freedom = error**2 / (x_error**2 / (n - 1) + y_error**2 / (m - 1))
    half = _student(float(freedom), coverage) * np.sqrt(error)
    low, value, high = np.exp(x.mean() - y.mean() + np.array([-half, 0.0, half]))
    return Ratio(float(value), float(low), float(high), min(n, m), paired=False)


def ratio_of(a: Mapping[Block, float], b: Mapping[Block, float]) -> Ratio | None:
    """Return the paired ratio of times if possible, otherwise the unpaired ratio.

    If there are too few times for either ratio, return None.

    a, b : times of the two solvers by block, in s
    """
    return paired_ratio(a, b) or unpaired_ratio(a.values(), b.values())


@cache
def _student(freedom: float, coverage: float = COVERAGE) -> float:
    """Return the half-width of a two-sided Student interval, in standard errors.

    freedom : degrees of freedom
    """
    return float(stdtrit(freedom, 0.5 + coverage / 2))
