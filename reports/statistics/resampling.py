"""Bootstrap over cases, which estimates the scatter between sets of problems.

The resampled unit is the case with the times of all solvers on it, so that solvers stay
paired [1]_. Scatter within a case (timing noise, for example) adds to the scatter
between cases, so the intervals include it.

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

#: number of resamples or sign flips; a share of 5 % then has a standard error of 0.5 %
DRAWS = 2000

Array = NDArray[np.float64]


def weights(cases: Sequence[str]) -> Array:
    """Draw the cases with replacement, `DRAWS` times.

    Returns
    -------
    (draws, cases) frequency of each case over the number of cases; rows sum to one

    """
    n = len(cases)
    return _rng(cases).multinomial(n, np.full(n, 1 / n), size=DRAWS) / n


def limits(draws: Array, cases: int) -> tuple[Array, Array]:
    """Return the 95 % interval of every column of (draws, …) statistics.

    Percentiles are expanded [2]_, because statistics of resamples of n cases scatter
    too little by the factor √((n−1)/n), and have normal instead of Student's tails. The
    lower percentile is Φ(−√(n/(n−1))·t₀.₉₇₅,ₙ₋₁), where Φ is the normal distribution
    function and t₀.₉₇₅,ₙ₋₁ is a quantile of Student's distribution. A monotone
    transform of the statistic transforms the interval in the same way.

    cases : number of cases n
    """
    tail = float(ndtr(-np.sqrt(cases / (cases - 1)) * student(cases - 1)))
    low, high = np.quantile(draws, (tail, 1 - tail), axis=0)
    return low, high


def significantly_faster(logs: Array, cases: Sequence[str]) -> NDArray[np.bool_]:
    """Determine the significantly faster solver of every pair, jointly at 95 %.

    If two solvers are equal, their times on a case are exchangeable: the sign of the
    difference d of their logarithms is random. In each flip, the signs of some cases
    are reversed for all pairs. The statistic of a pair is compared with the maxima over
    all pairs in the flips [3]_. There are two statistics: Σd/√Σd², which is equivalent
    to Student's t, and the same expression for the signed rank of d, which a few
    failures with a large penalty do not distort. A statistic is used only if it has the
    sign of the mean. The more significant of the two statistics is used, for the data
    and for every flip. Therefore, for any number of equal solvers, the probability that
    some pair is significant is at most 5 %. With fewer than six cases no pair is
    significant, because five signs agree by chance in 2 of 2⁵ flips.

    Parameters
    ----------
    logs : (cases, solvers) logarithms of the shifted times

    Returns
    -------
    (solvers, solvers) True where the row's solver is significantly faster than the
    column's

    """
    i, j = np.triu_indices(logs.shape[1], 1)
    d = logs[:, i] - logs[:, j]
    d[np.abs(d) <= 1e-12 * np.abs(logs).max()] = 0
    signs = _signs(cases)
    tests = [_flipped(d, signs), _flipped(np.sign(d) * _ranks(abs(d)), signs)]
    slower = np.sign(d.mean(axis=0))
    agree = np.array([np.sign(observed) == slower for observed, _ in tests])
    levels = np.array([_p_values(largest, np.abs(seen)) for seen, largest in tests])
    in_flips = np.array([_p_values(largest, largest) for _, largest in tests])
    level = _p_values(-in_flips.min(axis=0), -np.where(agree, levels, 1).min(axis=0))
    apart = level <= 1 - COVERAGE
    faster = np.zeros((logs.shape[1], logs.shape[1]), dtype=bool)
    faster[i, j] = apart & (slower < 0)
    faster[j, i] = apart & (slower > 0)
    return faster


def symmetric_interval(values: Array, cases: Sequence[str]) -> tuple[float, float]:
    """Return the 95 % interval of a mean by inversion of the sign-flip test.

    The means of all subsets of the values divide the line into intervals that each
    contain the centre of a symmetric distribution with the same probability [4]_. If
    there are too many subsets (see `_signs`), a random selection is used. For six
    values the interval is their range.

    values : (cases,) at least six, since fewer have no 95 % interval
    """
    signs = _signs(cases)
    subsets = np.vstack([signs > 0, signs < 0]).astype(float)
    sizes = subsets.sum(axis=1)
    means = np.sort((subsets @ values)[sizes > 0] / sizes[sizes > 0])
    k = max(int((1 - COVERAGE) / 2 * (means.size + 1)), 1)
    return float(means[k - 1]), float(means[-k])


def _signs(cases: Sequence[str]) -> Array:
    """Return all patterns of signs up to a common sign, or `DRAWS` random patterns.

    The first pattern, with all signs positive, represents the data.
    """
    n = len(cases)
    if 2 ** (n - 1) <= DRAWS:
        patterns = np.arange(2 ** (n - 1))[:, None] >> np.arange(n)
        return np.asarray(1.0 - 2 * (patterns & 1))
    signs = 1.0 - 2 * _rng(cases).integers(0, 2, (DRAWS, n))
    signs[0] = 1
    return np.asarray(signs)


def _flipped(scores: Array, signs: Array) -> tuple[Array, Array]:
    """Return Σs/√Σs² of each pair, and its maximum over the pairs in every flip.

    s are the scores of a pair, one per case.
    """
    size = np.sqrt((scores**2).sum(axis=0))
    unit = scores / np.where(size > 0, size, 1)
    return unit.sum(axis=0), np.abs(signs @ unit).max(axis=1, initial=0)


def _ranks(values: Array) -> Array:
    """Rank each column of (cases, pairs) values; equal values share the mean rank."""
    ranking = np.empty_like(values)
    for column, rank in zip(values.T, ranking.T, strict=True):
        order = np.sort(column)
        below, within = (order.searchsorted(column, side) for side in ("left", "right"))
        rank[:] = (below + within + 1) / 2
    return ranking


def _p_values(values: Array, by: Array) -> Array:
    """Return, for each entry of `by`, the share of `values` that are at least as large.

    Values that are equal up to rounding count.
    """
    below = np.searchsorted(np.sort(values), by - 1e-9)
    return np.asarray(1 - below / values.size)


def firsts(draws: Array) -> Array:
    """Return the share of draws in which each solver is fastest; ties are split evenly.

    draws : (draws, solvers)
    """
    least = draws.min(axis=1, keepdims=True)
    best = draws <= least + 1e-12 * (1 + np.abs(least))
    return np.asarray((best / best.sum(axis=1, keepdims=True)).mean(axis=0))


def _rng(cases: Sequence[str]) -> np.random.Generator:
    """Return a generator seeded by the names: equal cases give equal draws."""
    return np.random.default_rng(
        crc32("\n".join(cases).encode(errors="backslashreplace"))
    )
