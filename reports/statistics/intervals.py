"""Confidence intervals of a median and of an exponent."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from statistics import median
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import bdtr, stdtrit

COVERAGE = 0.95  #: nominal coverage; six samples are needed to reach it for a median


class Interval(NamedTuple):
    """An estimate with its confidence interval."""

    value: float
    low: float
    high: float
    coverage: float  #: probability that [low, high] contains the true value
    samples: int  #: number of samples behind the estimate


def student(freedom: float) -> float:
    """Return the half-width of Student's 95 % interval in standard errors."""
    return float(stdtrit(freedom, 0.5 + COVERAGE / 2))


def median_interval(samples: Sequence[float]) -> Interval:
    """Return the median and its distribution-free interval [x₍ₖ₎, x₍ₙ₊₁₋ₖ₎].

    The interval misses the true median only if fewer than k of the n independent
    samples lie on one side of it. For every continuous distribution, the coverage is
    therefore 1 − 2·P(X < k) with X ~ Bin(n, ½) [1]_. The largest k with a coverage of
    at least 95 % is used. Fewer than six samples cannot reach 95 %; then k = 1, the
    interval extends from the smallest to the largest sample, and its coverage is
    1 − 2¹⁻ⁿ.

    References
    ----------
    .. [1] H. A. David, H. N. Nagaraja, Order Statistics, 3rd ed., 2003, §7.1

    """
    x = sorted(float(s) for s in samples)
    n = len(x)
    k, coverage = _order(n)
    return Interval(
        value=median(x), low=x[k - 1], high=x[n - k], coverage=coverage, samples=n
    )


@cache
def _order(n: int) -> tuple[int, float]:
    """Return k and the coverage of the interval for n samples."""
    k = np.arange(1, (n + 1) // 2 + 1)
    coverages = 1 - 2 * bdtr(k - 1, n, 0.5)
    best = max(int((coverages >= COVERAGE).sum()), 1)
    return best, max(float(coverages[best - 1]), 0.0)


class PowerLaw(NamedTuple):
    """The fit t = c·nᵖ, with a 95 % interval [low, high] of the exponent p."""

    exponent: float
    low: float
    high: float
    log_factor: float  #: log c; c itself may overflow if the sizes differ little
    points: int

    @property
    def factor(self) -> float:
        """Factor c of c·nᵖ; infinite if it overflows."""
        with np.errstate(over="ignore"):
            return float(np.exp(self.log_factor))

    def at(self, n: NDArray[np.float64]) -> NDArray[np.float64]:
        """Evaluate the law at sizes n (k,), which should be near the fitted sizes."""
        return np.asarray(np.exp(self.log_factor + self.exponent * np.log(n)))


def power_law(n: ArrayLike, t_of_n: ArrayLike) -> PowerLaw:
    """Fit t = c·nᵖ by least squares on logarithms.

    The interval of p is Student's with points − 2 degrees of freedom. It is exact if
    the logarithms scatter normally about the line, and it is wide if the law does not
    hold. A bootstrap over the three to ten sizes of a scaling suite would cover far
    less than its nominal level.

    Parameters
    ----------
    n, t_of_n : (k,) positive, at least three different sizes

    Raises
    ------
    ValueError
        If fewer than three different sizes are given, or a value is not positive.

    """
    x, y = np.asarray(n, dtype=float), np.asarray(t_of_n, dtype=float)
    if np.unique(x).size < 3 or not ((x > 0).all() and (y > 0).all()):
        raise ValueError("a power law needs three different sizes and positive values")
    X, Y = np.log(x) - np.log(x).mean(), np.log(y)
    p = float(X @ Y / (X @ X))
    rest = Y - Y.mean() - p * X
    error = np.sqrt(rest @ rest / (x.size - 2) / (X @ X))
    half = float(student(x.size - 2) * error)
    log_factor = float(Y.mean() - p * np.log(x).mean())
    return PowerLaw(p, p - half, p + half, log_factor, x.size)
