"""Performance and data profiles: share of cases solved within a time ratio or a time.

References
----------
.. [1] E. D. Dolan, J. J. Moré, Benchmarking optimization software with performance
   profiles, Mathematical Programming 91 (2002) 201-213
.. [2] J. J. Moré, S. M. Wild, Benchmarking Derivative-Free Optimization Algorithms,
   SIAM J. Optimization 20 (2009) 172-191
.. [3] N. Gould, J. Scott, A Note on Performance Profiles for Benchmarking Software,
   ACM Trans. Mathematical Software 43 (2016) 15:1-15:5
.. [4] C. J. Clopper, E. S. Pearson, The Use of Confidence or Fiducial Limits,
   Biometrika 26 (1934) 404-413

"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betainccinv, betaincinv

from mortarbench.reports.statistics.intervals import COVERAGE

POINTS = 200  #: maximum number of steps of a curve; curves with more are sampled

Array = NDArray[np.float64]


class Share(NamedTuple):
    """Share of the cases with its pointwise 95 % interval."""

    value: Array
    low: Array
    high: Array


class Curve(NamedTuple):
    """Step function with the value share[i] from at[i] to at[i + 1]."""

    at: Array
    share: Share


def performance_ratios(times: Array) -> Array:
    """Return ratios r = t/min t to the best solver of each case [1]_; inf for failures.

    A case that no solver solved is kept with infinite ratios; no profile then reaches
    one. The profile of a solver at τ is the share of cases with r ≤ τ.

    Parameters
    ----------
    times : (cases, solvers) positive; inf where unsolved

    """
    best = times.min(axis=1, keepdims=True)
    return np.where(np.isinf(times), np.inf, times / np.where(np.isinf(best), 1, best))


def share(counts: ArrayLike, cases: int) -> Share:
    """Return the share counts/cases with its binomial interval [4]_.

    Unlike a percentile interval, this interval has at least nominal coverage, and its
    width is positive even if all or no cases are solved.
    """
    # Among resampled cases, the number solved is binomial, so no draws are needed.
    k = np.asarray(counts, dtype=float)
    tail = (1 - COVERAGE) / 2
    return Share(
        value=k / cases,
        low=np.where(k > 0, betaincinv(np.maximum(k, 1), cases - k + 1, tail), 0.0),
        high=np.where(
            k < cases, betainccinv(k + 1, np.maximum(cases - k, 1), tail), 1.0
        ),
    )


def solved_within(values: Array, places: ArrayLike) -> Share:
    """Return, for each of the finite `places`, the share of cases with value ≤ place.

    values : (cases,) ratios for a performance profile, seconds for a data profile [2]_
    """
    counts = np.searchsorted(np.sort(values), np.asarray(places), "right")
    return share(counts, values.size)


def curve(values: Array, start: float, stop: float, points: int = POINTS) -> Curve:
    """Return the profile of `values` between the finite `start` and `stop`."""
    inside = np.unique(values[(values > start) & (values < stop)])
    if inside.size > points:
        inside = np.geomspace(start, stop, points)[1:-1]
    at = np.concatenate([[start], inside, [stop]])
    return Curve(at, solved_within(values, at))
