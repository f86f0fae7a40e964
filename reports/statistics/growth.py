"""Power laws fitted to few sizes: whether values grow, and what they will be.

References
----------
.. [1] N. R. Draper, H. Smith, Applied Regression Analysis, 3rd ed., 1998, §1.4, 3.1

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtr, stdtrit

from reports.statistics.intervals import COVERAGE, Interval, power_law

SIZES = 4  #: fewer different sizes make no test: two degrees of freedom at least
LEVEL = 0.05  #: of the test
_ROUNDING = 1e-12  #: scatter of logarithms that is none


@dataclass(frozen=True, kw_only=True)
class Growth:
    """The fit v = c·nᵖ of positive values by least squares on logarithms."""

    exponent: float  #: p
    most: float  #: one-sided 95 % bound: p is at most this
    p_value: float  #: of p ≤ 0: how often as much growth would be seen without any
    log_factor: float  #: log c
    scatter: float  #: standard deviation of log v about the line
    sizes: tuple[float, ...]  #: n, that were measured

    @property
    def grows(self) -> bool:
        """Whether p ≤ 0 is rejected."""
        return self.p_value < LEVEL

    def at(self, n: float) -> Interval:
        """Predict v at a size within the measured range, with its 95 % interval.

        The interval is that of a further measurement [1]_.

        Raises
        ------
        ValueError
            Outside of the measured range, where nothing supports the law.

        """
        low, high = min(self.sizes), max(self.sizes)
        if not low <= n <= high:
            raise ValueError(
                f"n = {n:g} is outside of the measured {low:g} to {high:g}"
            )
        x = np.log(self.sizes)
        k = x.size
        off = np.log(n) - x.mean()
        spread = float((x - x.mean()) @ (x - x.mean()))
        error = self.scatter * np.sqrt(1 + 1 / k + off**2 / spread)
        half = float(stdtrit(k - 2, 0.5 + COVERAGE / 2) * error)
        value = np.exp(self.log_factor + self.exponent * np.log(n))
        ends = value * np.exp(-half), value * np.exp(half)
        return Interval(float(value), float(ends[0]), float(ends[1]), COVERAGE, k)


def growth_of(n: ArrayLike, values: ArrayLike) -> Growth:
    """Test that values do not grow with n: p ≤ 0 in v = c·nᵖ, one-sided.

    Student's test of the slope on logarithms with k − 2 degrees of freedom.

    Parameters
    ----------
    n, values : (k,) positive, at least four different sizes

    Raises
    ------
    ValueError
        When fewer than four different sizes are given, or a value is not positive.

    """
    x, y = np.asarray(n, dtype=float), np.asarray(values, dtype=float)
    if np.unique(x).size < SIZES or not ((x > 0).all() and (y > 0).all()):
        raise ValueError("a test of growth needs four different sizes, positive values")
    law = power_law(x, y)
    spread = float(np.linalg.norm(np.log(x) - np.log(x).mean()))
    error = (law.high - law.low) / 2 / float(stdtrit(x.size - 2, 0.5 + COVERAGE / 2))
    if error * spread <= _ROUNDING:  # as of counts that are all the same
        error = 0.0
    p = law.exponent if abs(law.exponent) * spread > _ROUNDING else 0.0
    return Growth(
        exponent=p,
        most=p + float(stdtrit(x.size - 2, 1 - LEVEL)) * error,
        p_value=float(stdtr(x.size - 2, -p / error)) if error else float(p <= 0),
        log_factor=law.log_factor,
        scatter=error * spread,
        sizes=tuple(map(float, x)),
    )
