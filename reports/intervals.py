"""Estimates with 95 % intervals: medians, ratios pooled over cases, exponents.

Times are compared by their logarithms, so that a ratio and its reciprocal have
reciprocal intervals.

The times of all repeats in one process share a factor, because the addresses of code
and data decide which of them share a place in the caches [1]_. A run measures each
solver in one process, so that repeats do not show this factor, but further sessions do.

References
----------
.. [1] T. Mytkowicz, A. Diwan, M. Hauswirth, P. F. Sweeney, Producing wrong data without
   doing anything obviously wrong!, ASPLOS 2009

"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import bdtr, ndtri, stdtrit

COVERAGE = 0.95  #: nominal coverage of all intervals
#: Standard deviation of the logarithm of the factor of a process. It was 0.038 for 240
#: processes that executed the same work (29 November 2026, quiet).
PROCESS = 0.04
LEAST_REPEATS = 3  #: repeats of a single case from which on its ratio has an interval

Array = NDArray[np.float64]


class Interval(NamedTuple):
    """An estimate with its 95 % interval; the ends are NaN if there is none."""

    value: float
    low: float
    high: float

    @property
    def is_known(self) -> bool:
        """True if the estimate has an interval."""
        return bool(np.isfinite(self.low) and np.isfinite(self.high))


def student(freedom: float) -> float:
    """Return the half-width of Student's 95 % interval in standard errors."""
    return float(stdtrit(freedom, 0.5 + COVERAGE / 2))


def widened(half: float, sessions: int) -> float:
    """Add the factors of both processes to the half-width of the log of a ratio.

    sessions : number of sessions, in each of which a solver had one process
    """
    error = PROCESS * np.sqrt(2 / sessions)
    return float(np.hypot(half, ndtri(0.5 + COVERAGE / 2) * error))


def median_interval(samples: ArrayLike) -> Interval:
    """Return the median and its distribution-free interval [x₍ₖ₎, x₍ₙ₊₁₋ₖ₎].

    The largest k with 1 − 2·P(X < k) ≥ 0.95, X ~ Bin(n, ½), is used [1]_. Below six
    samples no such k exists, and the interval is the range of the samples.

    References
    ----------
    .. [1] H. A. David, H. N. Nagaraja, Order Statistics, 3rd ed., 2003, §7.1

    """
    x = np.sort(np.asarray(samples, dtype=float))
    k = np.arange(1, (x.size + 1) // 2 + 1)
    best = max(int((1 - 2 * bdtr(k - 1, x.size, 0.5) >= COVERAGE).sum()), 1)
    return Interval(float(np.median(x)), float(x[best - 1]), float(x[-best]))


class Pooled(NamedTuple):
    """A ratio of times, pooled over cases and repeats."""

    ratio: Interval  #: geometric mean over the cases
    cases: int
    repeats: float  #: mean number of repeats per case
    sessions: int  #: number of processes of each solver
    #: standard deviation of the logarithm within a case; NaN for single repeats
    noise: float
    scatter: float  #: standard deviation between cases without the part due to noise

    def separable(self, repeats: int) -> float:
        """Return the factor above which `repeats` repeats would separate two solvers.

        The result is infinite if noise or scatter is unknown.
        """
        if self.cases > 1:
            error = np.hypot(self.scatter, self.noise / np.sqrt(repeats))
            half = student(self.cases - 1) * error / np.sqrt(self.cases)
        else:
            half = student(repeats - 1) * self.noise / np.sqrt(repeats)
        half = widened(half, self.sessions)
        return float(np.exp(half)) if np.isfinite(half) else np.inf


def pooled(logs: Sequence[ArrayLike], sessions: int = 1) -> Pooled:
    """Pool logarithms of ratios over cases, by Student's interval.

    The logarithms of one case are replaced by their median. With two or more cases,
    Student's interval of the mean over cases contains the scatter between cases and,
    since each median contains it, the noise of the repeats. With one case, Student's
    interval of the mean over repeats is used, from `LEAST_REPEATS` repeats on. Both are
    widened by the factors of processes.

    logs : for each case, the logarithms of its repeats (r,), r ≥ 1
    """
    arrays = [np.asarray(of, dtype=float) for of in logs]
    middle = np.array([np.median(of) for of in arrays])
    cases, repeats = len(arrays), float(np.mean([of.size for of in arrays]))
    within = [of.var(ddof=1) for of in arrays if of.size > 1]
    noise = float(np.sqrt(np.mean(within))) if within else np.nan
    scatter = half = np.nan
    if cases > 1:
        spread = middle.std(ddof=1)
        half = student(cases - 1) * spread / np.sqrt(cases)
        scatter = np.sqrt(max(spread**2 - (noise**2 / repeats if within else 0), 0))
    elif repeats >= LEAST_REPEATS:
        middle, scatter = arrays[0], 0.0
        half = student(repeats - 1) * noise / np.sqrt(repeats)
    half = widened(float(half), sessions)
    low, value, high = np.exp(middle.mean() + np.array([-half, 0, half]))
    ratio = Interval(float(value), float(low), float(high))
    return Pooled(ratio, cases, repeats, sessions, noise, float(scatter))


class PowerLaw(NamedTuple):
    """The law t = c·xᵖ in several series, each with its own factor c."""

    exponent: Interval
    points: int


def power_law(series: Sequence[tuple[ArrayLike, ArrayLike]]) -> PowerLaw | None:
    """Fit one exponent p to series (x, t) by least squares on logarithms.

    The interval of p is Student's, with one degree of freedom less for the exponent and
    for each series. Series with a single size do not contribute. The result is None if
    fewer than three sizes remain.
    """
    X, Y, sizes, used = [], [], set[float](), 0
    for x, t in series:
        a, b = np.log(np.asarray(x, dtype=float)), np.log(np.asarray(t, dtype=float))
        if np.unique(a).size > 1:
            X.append(a - a.mean())
            Y.append(b - b.mean())
            sizes |= set(a.tolist())
            used += 1
    if len(sizes) < 3:
        return None
    at, of = np.concatenate(X), np.concatenate(Y)
    p = float(at @ of / (at @ at))
    freedom = at.size - used - 1
    half = np.nan
    if freedom > 0:
        rest = of - p * at
        half = student(freedom) * float(np.sqrt(rest @ rest / freedom / (at @ at)))
    return PowerLaw(Interval(p, p - half, p + half), at.size)
