"""Restricted mean of times that are censored by a time limit.

References
----------
.. [1] E. L. Kaplan, P. Meier, Nonparametric Estimation from Incomplete Observations,
   J. American Statistical Association 53 (1958) 457-481
.. [2] J. P. Klein, M. L. Moeschberger, Survival Analysis, 2nd ed., 2003, §4.5

"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.reports.statistics.intervals import COVERAGE, Interval, student

Array = NDArray[np.float64]


class Restricted(NamedTuple):
    """Mean of min(t, horizon) over the cases, and the number of cases by ending."""

    mean: Interval  #: s
    solved: int
    stopped: int  #: number of cases stopped at the time limit, which are censored
    never: int  #: number of cases that ended earlier without a verified answer


def restricted_mean(times: Array, stopped: Array, horizon: float) -> Restricted:
    """Estimate the mean of min(t, horizon): ∫ S dt from 0 to the horizon.

    S is the Kaplan-Meier estimate [1]_ of the share of cases that are unsolved at t. A
    case that reached the time limit is censored: its t exceeds the limit. A refuted
    answer, a crash and an iteration limit do not depend on time, so t is infinite. If
    every time limit is at the horizon, this is the plain mean of min(t, horizon).

    At time tᵢ, dᵢ of the nᵢ cases at risk are solved, and Aᵢ is the integral of S from
    tᵢ to the horizon. The variance is Σ Aᵢ²·dᵢ/(nᵢ(nᵢ − dᵢ)) [2]_, multiplied by
    n/(n − 1) for n cases. The interval is Student's with n − 1 degrees of freedom,
    truncated at 0 and at the horizon.

    Parameters
    ----------
    times : (cases,) s; inf without a verified answer
    stopped : (cases,) s until the time limit; NaN for other endings
    horizon : upper limit of the times that enter the mean, s

    """
    n = times.size
    late = np.isinf(times) & ~np.isnan(stopped)
    ends = np.minimum(np.where(late, stopped, times), horizon)
    censored = times > horizon
    at = np.unique(ends)
    at_risk = n - np.searchsorted(np.sort(ends), at)
    solved = np.searchsorted(np.sort(ends[~censored]), at, "right")
    solved = np.diff(np.append(0, solved))
    survival = np.cumprod(1 - solved / at_risk)
    knots = np.append(at, max(horizon, at[-1]))
    areas = np.diff(np.append(0.0, knots)) * np.append(1.0, survival)
    mean = float(areas.sum())
    left = np.cumsum(areas[:0:-1])[::-1]  # ∫ of S from each knot to the horizon
    rest = np.maximum(at_risk - solved, 1)  # `left` is 0 where no case is at risk
    variance = float((left**2 * solved / (at_risk * rest)).sum()) * n / (n - 1)
    half = student(n - 1) * variance**0.5
    low, high = max(mean - half, 0.0), min(mean + half, horizon)
    return Restricted(
        mean=Interval(mean, low, high, COVERAGE, n),
        solved=int(np.isfinite(times).sum()),
        stopped=int(late.sum()),
        never=int((np.isinf(times) & ~late).sum()),
    )
