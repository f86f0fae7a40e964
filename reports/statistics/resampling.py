"""The bootstrap over cases: what another draw of problems would have said.

The resampled unit is the case, with the times of all solvers on it: solvers stay
paired [1]_. What scatters within a case (noise of the clock) scatters between cases,
too, so that the intervals contain it.

References
----------
.. [1] B. Efron, R. J. Tibshirani, An Introduction to the Bootstrap, 1993, ch. 6, 13
.. [2] T. C. Hesterberg, What Teachers Should Know About the Bootstrap, The American
   Statistician 69 (2015) 371-386, §4.2
.. [3] P. H. Westfall, S. S. Young, Resampling-Based Multiple Testing, 1993, ch. 2
.. [4] J. A. Hartigan, Using Subsample Values as Typical Values, JASA 64 (1969)
   1303-1317

"""

from __future__ import annotations

from collections.abc import Sequence
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from mortarbench.reports.statistics.intervals import COVERAGE, student

DRAWS = 2000

Array = NDArray[np.float64]


def weights(cases: Sequence[str]) -> Array:
    """Draw the cases with replacement, `DRAWS` times.

    Returns
    -------
    (draws, cases) how often each is drawn, over the number of cases: rows sum to one

    """
    n = len(cases)
    return _rng(cases).multinomial(n, np.full(n, 1 / n), size=DRAWS) / n


def limits(draws: Array, cases: int) -> tuple[Array, Array]:
    """Take the 95 % interval of every column of (draws, …) statistics.

    Percentiles, expanded [2]_: a resample of n cases scatters by √((n−1)/n) too little
    and with normal instead of Student's tails, so the quantile asked for is that of
    −√(n/(n−1))·t₀.₉₇₅,ₙ₋₁ under the normal law. Order is kept: a transform of the
    statistic transforms the interval.
    """
    tail = float(ndtr(-np.sqrt(cases / (cases - 1)) * student(cases - 1)))
    low, high = np.quantile(draws, (tail, 1 - tail), axis=0)
    return low, high


def told_apart(logs: Array, cases: Sequence[str]) -> NDArray[np.bool_]:
    """Determine which solvers are faster than which, jointly at 95 %.

    If two solvers are alike, their times on a case might as well be exchanged: the sign
    of the difference of logarithms is a coin. The signs of whole cases are flipped, and
    the statistics of a pair are compared with the largest over all pairs in every flip
    [3]_. There are two: Σd/√Σd², which is Student's in other words, and the same of
    signed ranks, which a few failures with a large penalty cannot blunt; it counts only
    where it agrees with the mean. The better of the two is taken, in the flips as well,
    so that among equal solvers, whatever their number, one set of cases in twenty tells
    any pair apart. Below six cases none can: all signs agree in 2 of 2⁵.

    Parameters
    ----------
    logs : (cases, solvers) logarithms of what is averaged

    Returns
    -------
    (solvers, solvers) whether row is told to be faster than column

    """
    i, j = np.triu_indices(logs.shape[1], 1)
    d = logs[:, i] - logs[:, j]
    d[np.abs(d) <= 1e-12 * np.abs(logs).max()] = 0
    signs = _signs(cases)
    tests = [_flipped(d, signs), _flipped(np.sign(d) * _ranks(abs(d)), signs)]
    slower = np.sign(d.mean(axis=0))
    agree = np.array([np.sign(observed) == slower for observed, _ in tests])
    levels = np.array([_beaten(largest, np.abs(seen)) for seen, largest in tests])
    in_flips = np.array([_beaten(largest, largest) for _, largest in tests])
    level = _beaten(-in_flips.min(axis=0), -np.where(agree, levels, 1).min(axis=0))
    apart = level <= 1 - COVERAGE
    faster = np.zeros((logs.shape[1], logs.shape[1]), dtype=bool)
    faster[i, j] = apart & (slower < 0)
    faster[j, i] = apart & (slower > 0)
    return faster


def symmetric_interval(values: Array, cases: Sequence[str]) -> tuple[float, float]:
    """Return the 95 % interval of a mean that flipping the signs of values inverts to.

    The means of all subsets of the values cut the line into pieces that hold the centre
    of a symmetric distribution equally often [4]_; beyond `DRAWS` subsets, those that
    are drawn. From six values the interval is that from the least to the largest.

    values : (cases,) at least six; fewer have no interval of 95 %
    """
    signs = _signs(cases)
    subsets = np.vstack([signs > 0, signs < 0]).astype(float)
    sizes = subsets.sum(axis=1)
    means = np.sort((subsets @ values)[sizes > 0] / sizes[sizes > 0])
    k = max(int((1 - COVERAGE) / 2 * (means.size + 1)), 1)
    return float(means[k - 1]), float(means[-k])


def _signs(cases: Sequence[str]) -> Array:
    """Patterns of signs, up to a common one: all of them, or else `DRAWS`.

    The first is that of the data.
    """
    n = len(cases)
    if 2 ** (n - 1) <= DRAWS:
        patterns = np.arange(2 ** (n - 1))[:, None] >> np.arange(n)
        return np.asarray(1.0 - 2 * (patterns & 1))
    signs = 1.0 - 2 * _rng(cases).integers(0, 2, (DRAWS, n))
    signs[0] = 1
    return np.asarray(signs)


def _flipped(scores: Array, signs: Array) -> tuple[Array, Array]:
    """Statistic Σs/√Σs² of each pair, and the largest of all pairs in every flip."""
    size = np.sqrt((scores**2).sum(axis=0))
    unit = scores / np.where(size > 0, size, 1)
    return unit.sum(axis=0), np.abs(signs @ unit).max(axis=1, initial=0)


def _ranks(values: Array) -> Array:
    """Rank every column of (cases, pairs) values; equal ones share their mean rank."""
    ranks = np.empty_like(values)
    for column, rank in zip(values.T, ranks.T, strict=True):
        order = np.sort(column)
        below, within = (order.searchsorted(column, side) for side in ("left", "right"))
        rank[:] = (below + within + 1) / 2
    return ranks


def _beaten(values: Array, by: Array) -> Array:
    """Share of the values that are at least as large, but for rounding."""
    below = np.searchsorted(np.sort(values), by - 1e-9)
    return np.asarray(1 - below / values.size)


def firsts(draws: Array) -> Array:
    """Share of the draws in which each solver has the smallest mean; ties share one.

    draws : (draws, solvers)
    """
    least = draws.min(axis=1, keepdims=True)
    best = draws <= least + 1e-12 * (1 + np.abs(least))
    return np.asarray((best / best.sum(axis=1, keepdims=True)).mean(axis=0))


def _rng(cases: Sequence[str]) -> np.random.Generator:
    """Seed by names, so that the same cases are drawn alike everywhere."""
    return np.random.default_rng(
        crc32("\n".join(cases).encode(errors="backslashreplace"))
    )
