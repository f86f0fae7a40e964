"""Time at equal error: time that a solver needs for a prescribed certified error.

A solver is run at several tolerances, which yields points (certified error, time).
Isotonic regression removes decreases of time with accuracy, because a more accurate
answer should not take less time [1]_. The time is then interpolated linearly in the
logarithms between the points, and never extrapolated.

A point is used if the solver claimed success and a certificate bounds its error. The
claim shows only that the solver stopped by its own criterion and not at a limit.
Whether residuals refute the claim is irrelevant here, since the error is certified.

References
----------
.. [1] R. E. Barlow, D. J. Bartholomew, J. M. Bremner, H. D. Brunk, Statistical
   Inference under Order Restrictions, 1972

"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Verdict
from mortarbench.harness.digest import hex_digest
from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.statistics.intervals import COVERAGE, Interval
from mortarbench.reports.statistics.resampling import limits

RESAMPLES = 400  #: number of bootstrap resamples; 10 of them form a tail of 2.5 %
SMALLEST = 1e-17  #: smaller errors are raised to this value, since log 0 = −∞

Floats = NDArray[np.float64]


class TimeAtAccuracy(NamedTuple):
    """Time at a prescribed error; see `time_at_accuracy`."""

    #: "between" two measured errors; "looser" than every measured error; "not reached"
    kind: str
    #: time in s; None if not reached; for "looser", an upper bound, namely the time at
    #: the largest measured error
    time: Interval | None


def counts(outcome: Outcome) -> bool:
    """Return whether an outcome may be used as a point (certified error, time)."""
    limited = outcome.verdict in (Verdict.TIME_LIMIT, Verdict.MEMORY_LIMIT)
    return (
        outcome.claims == ("solved",)
        and all(r.claimed and r.energy_bound is not None for r in outcome.records)
        and outcome.seconds("total") is not None
        and not limited
    )


def time_at_accuracy(outcomes: Sequence[Outcome], error: float) -> TimeAtAccuracy:
    """Interpolate the time in which a solver reaches a certified error of `error`.

    The interval comes from a bootstrap over the repeats at each tolerance, seeded by
    the run_ids, and is widened for few repeats (see `resampling.limits`). If a
    tolerance has only one repeat, both ends of the interval equal the value.

    outcomes : outcomes of one solver on one case, at all tolerances
    """
    points = [o for o in outcomes if counts(o)]
    if not points:
        return TimeAtAccuracy("not reached", None)
    errors = np.array([max(o.largest("energy_bound") or 0.0, SMALLEST) for o in points])
    if error < errors.min():
        return TimeAtAccuracy("not reached", None)
    if error > errors.max():
        loosest = max(points, key=lambda o: (o.largest("energy_bound") or 0.0, o.tol))
        return TimeAtAccuracy("looser", loosest.seconds("total"))
    samples = [
        np.array([r.total_seconds for r in o.records if r.total_seconds])
        for o in points
    ]
    value = float(times_at(error, errors, np.array([np.median(t) for t in samples])))
    drawn = [_medians(t, o) for t, o in zip(samples, points, strict=True)]
    times = times_at(error, errors, np.transpose(drawn))
    fewest = min(t.size for t in samples)
    low, high = limits(times, fewest) if fewest > 1 else (value, value)
    return TimeAtAccuracy(
        "between", Interval(value, float(low), float(high), COVERAGE, fewest)
    )


def times_at(error: float, errors: Floats, times: Floats) -> Floats:
    """Interpolate times monotonically at `error`, linearly in the logarithms.

    Parameters
    ----------
    error : between the smallest and the largest of `errors`
    errors : (k,) positive; equal errors are merged, with the geometric mean of times
    times : (…, k) s, positive; any number of curves

    Returns
    -------
    (…,) times of the curves at `error`, s

    """
    places, point, weights = np.unique(
        -np.log(errors), return_inverse=True, return_counts=True
    )
    logs = np.log(times)
    y = [logs[..., point == i].mean(axis=-1) for i in range(places.size)]
    hats = [np.interp(-np.log(error), places, hat) for hat in np.eye(places.size)]
    times_there: Floats = np.exp(isotonic(np.stack(y, axis=-1), weights) @ hats)
    return times_there


def isotonic(y: Floats, weights: NDArray[np.integer]) -> Floats:
    """Fit nondecreasing values by weighted least squares: the max-min formula of [1]_.

    The fit at i is the maximum over start ≤ i of the minimum over end ≥ i of the
    weighted mean of y from start to end.

    y : (…, k); each row of k values is fitted separately
    weights : (k,) positive
    """
    before = np.cumsum([0, *weights])
    start = np.zeros((*y.shape[:-1], 1))
    sums = np.concatenate([start, np.cumsum(weights * y, axis=-1)], axis=-1)
    fit = np.empty_like(y)
    for i in range(y.shape[-1]):
        begin, end = slice(i + 1), slice(i + 1, None)
        means = (sums[..., None, end] - sums[..., begin, None]) / (
            before[end] - before[begin, None]
        )
        fit[..., i] = means.min(axis=-1).max(axis=-1)
    return fit


def _medians(times: Floats, outcome: Outcome) -> Floats:
    """Draw medians of resampled repeats, with a generator seeded by the run_ids."""
    names = "\n".join(outcome.run_ids).encode("utf-8", "replace")
    seed = int(hex_digest([names], 16), 16)
    chosen = np.random.default_rng(seed).choice(times, (RESAMPLES, times.size))
    return np.asarray(np.median(chosen, axis=1))
