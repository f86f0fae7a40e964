"""Power laws fitted to few sizes: practically relevant growth, and predictions.

Growth is judged by its magnitude. The values change by the factor 10ᵖ when n is
multiplied by ten; the 95 % interval of this factor is compared with 1 ± `PRACTICAL`. A
test of the hypothesis p ≤ 0 would report irrelevant growth, such as that of the counts
1000, 1001, 1002, 1003, as significant whenever the counts scatter little.

References
----------
.. [1] N. R. Draper, H. Smith, Applied Regression Analysis, 3rd ed., 1998, §1.4, 3.1

"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from mortarbench.reports.statistics.intervals import (
    COVERAGE,
    Interval,
    power_law,
    student,
)

SIZES = 4  #: minimum number of sizes, which leaves two degrees of freedom
PRACTICAL = 0.10  #: relative change per decade of n below which growth is irrelevant
_ROUNDING = 1e-12  #: smaller scatter of logarithms counts as rounding


class Trend(Enum):
    """Conclusions from the interval of the factor 10ᵖ per decade of n."""

    GROWS = "grow"  #: interval above 1 + PRACTICAL
    FLAT = "flat"  #: interval within 1 ± PRACTICAL
    FALLS = "fall"  #: interval below 1 − PRACTICAL
    UNDECIDED = "not decided"


@dataclass(frozen=True, kw_only=True)
class Growth:
    """The fit v = c·nᵖ of positive values by least squares on logarithms."""

    exponent: float  #: exponent p
    low: float  #: lower end of the 95 % interval of p
    high: float  #: upper end of the 95 % interval of p
    log_factor: float  #: log c
    scatter: float  #: standard deviation of log v about the line
    sizes: tuple[float, ...]  #: measured n

    @property
    def per_decade(self) -> tuple[float, float, float]:
        """Relative change when n is multiplied by ten, and its interval."""
        change, low, high = (
            float(np.expm1(p * np.log(10)))
            for p in (self.exponent, self.low, self.high)
        )
        return change, low, high

    @property
    def trend(self) -> Trend:
        """Conclusion from comparing the change per decade with ±`PRACTICAL`."""
        _, low, high = self.per_decade
        if low > PRACTICAL:
            return Trend.GROWS
        if high < -PRACTICAL:
            return Trend.FALLS
        within = low >= -PRACTICAL and high <= PRACTICAL
        return Trend.FLAT if within else Trend.UNDECIDED

    def at(self, n: float) -> Interval:
        """Predict v at a size within the measured range, with its 95 % interval.

        The interval is a prediction interval for one further measurement [1]_.

        Raises
        ------
        ValueError
            If n is outside the measured range, where no data support the law.

        """
        low, high = min(self.sizes), max(self.sizes)
        if not low <= n <= high:
            raise ValueError(
                f"n = {n:g} is outside the measured range {low:g} to {high:g}"
            )
        x = np.log(self.sizes)
        k = x.size
        off = np.log(n) - x.mean()
        spread = float((x - x.mean()) @ (x - x.mean()))
        error = self.scatter * np.sqrt(1 + 1 / k + off**2 / spread)
        half = float(student(k - 2) * error)
        value = np.exp(self.log_factor + self.exponent * np.log(n))
        ends = value * np.exp(-half), value * np.exp(half)
        return Interval(float(value), float(ends[0]), float(ends[1]), COVERAGE, k)


def growth_of(n: ArrayLike, values: ArrayLike) -> Growth:
    """Fit v = c·nᵖ; the interval of p is Student's with k − 2 degrees of freedom.

    Parameters
    ----------
    n, values : (k,) positive, at least four different sizes

    Raises
    ------
    ValueError
        If fewer than four different sizes are given, or a value is not positive.

    """
    x, y = np.asarray(n, dtype=float), np.asarray(values, dtype=float)
    if np.unique(x).size < SIZES or not ((x > 0).all() and (y > 0).all()):
        raise ValueError("growth needs four different sizes and positive values")
    law = power_law(x, y)
    spread = float(np.linalg.norm(np.log(x) - np.log(x).mean()))
    half = student(x.size - 2)
    error = (law.high - law.low) / 2 / half
    if error * spread <= _ROUNDING:  # equal counts
        error = 0.0
    p = law.exponent if abs(law.exponent) * spread > _ROUNDING else 0.0
    return Growth(
        exponent=p,
        low=p - half * error,
        high=p + half * error,
        log_factor=law.log_factor,
        scatter=error * spread,
        sizes=tuple(map(float, x)),
    )
