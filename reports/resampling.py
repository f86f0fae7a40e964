"""The bootstrap over cases: what another draw of problems would have said.

The resampled unit is the case, with the times of all solvers on it: solvers stay
paired [1]_. What scatters within a case (noise of the clock) scatters between cases,
too, so that the intervals contain it.

References
----------
.. [1] B. Efron, R. J. Tibshirani, An Introduction to the Bootstrap, 1993, ch. 6, 13
.. [2] T. C. Hesterberg, What Teachers Should Know About the Bootstrap, The American
   Statistician 69 (2015) 371-386, §4.2
.. [3] M. Mogstad, J. P. Romano, A. M. Shaikh, D. Wilhelm, Inference for Ranks,
   Review of Economic Studies 91 (2024) 476-518

"""

from __future__ import annotations

from collections.abc import Sequence
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

from reports.intervals import COVERAGE

DRAWS = 2000

Array = NDArray[np.float64]


def weights(cases: Sequence[str]) -> Array:
    """Draw the cases with replacement, `DRAWS` times.

    The seed comes from the names, so that the same cases are drawn alike everywhere.

    Returns
    -------
    (draws, cases) how often each is drawn, over the number of cases: rows sum to one

    """
    n = len(cases)
    rng = np.random.default_rng(crc32("\n".join(cases).encode()))
    return rng.multinomial(n, np.full(n, 1 / n), size=DRAWS) / n


def limits(draws: Array, cases: int) -> tuple[Array, Array]:
    """Take the 95 % interval of every column of (draws, …) statistics.

    Percentiles, expanded [2]_: a resample of n cases scatters by √((n−1)/n) too little
    and with normal instead of Student's tails, so the quantile asked for is that of
    −√(n/(n−1))·t₀.₉₇₅,ₙ₋₁ under the normal law. Order is kept: a transform of the
    statistic transforms the interval.
    """
    tail = float(norm.cdf(-_student(cases)))
    low, high = np.quantile(draws, (tail, 1 - tail), axis=0)
    return low, high


def told_apart(point: Array, draws: Array, cases: int) -> NDArray[np.bool_]:
    """Tell which solvers are faster than which, all statements at 95 % together.

    The largest studentised deviation over all pairs of solvers is resampled, and its
    95 % quantile is the factor of every pair's error: single-step max-t [3]_. Among
    equal solvers, whatever their number, one resampled family in twenty names any pair.

    Parameters
    ----------
    point : (solvers,) logarithms of means
    draws : (draws, solvers) the same, resampled

    Returns
    -------
    (solvers, solvers) whether row is told to be faster than column

    """
    i, j = np.triu_indices(point.size, 1)
    if not i.size:
        return np.zeros((point.size, point.size), dtype=bool)
    gap = point[i] - point[j]
    deviation = draws[:, i] - draws[:, j] - gap
    error = np.sqrt((deviation**2).mean(axis=0))
    sure = error <= 1e-12 * (1 + np.abs(gap))  # no scatter at all
    largest = (np.abs(deviation) / np.where(sure, np.inf, error)).max(axis=1)
    factor = float(np.quantile(largest, COVERAGE))
    factor *= _student(cases) / float(norm.ppf(0.5 + COVERAGE / 2))
    apart = np.abs(gap) > np.where(sure, 1e-12 * (1 + np.abs(gap)), factor * error)
    faster = np.zeros((point.size, point.size), dtype=bool)
    faster[i, j] = apart & (gap < 0)
    faster[j, i] = apart & (gap > 0)
    return faster


def firsts(draws: Array) -> Array:
    """Share of the draws in which each solver has the smallest mean; ties share one.

    draws : (draws, solvers)
    """
    least = draws.min(axis=1, keepdims=True)
    best = draws <= least + 1e-12 * (1 + np.abs(least))
    return np.asarray((best / best.sum(axis=1, keepdims=True)).mean(axis=0))


def _student(n: int) -> float:
    """Half-width, in errors of the mean as resampled, of a 95 % interval from n."""
    return float(np.sqrt(n / (n - 1)) * t.ppf(0.5 + COVERAGE / 2, n - 1))
