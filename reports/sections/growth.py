"""Do iterations grow with the size? And the time at the largest size, from the fit.

References
----------
.. [1] N. R. Draper, H. Smith, Applied Regression Analysis, 3rd ed., 1998, §1.4, 3.1

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t

from reports.data.size_series import SizeSeries
from reports.document.formatting import ABSENT, clean, seconds
from reports.document.layout import Cell, Section, Table
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
    factor: float  #: c
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
        half = float(t.ppf(0.5 + COVERAGE / 2, k - 2) * error)
        value = self.factor * n**self.exponent
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
    error = (law.high - law.low) / 2 / float(t.ppf(0.5 + COVERAGE / 2, x.size - 2))
    if error * spread <= _ROUNDING:  # as of counts that are all the same
        error = 0.0
    p = law.exponent if abs(law.exponent) * spread > _ROUNDING else 0.0
    return Growth(
        exponent=p,
        most=p + float(t.ppf(1 - LEVEL, x.size - 2)) * error,
        p_value=float(t.sf(p / error, x.size - 2)) if error else float(p <= 0),
        factor=law.factor,
        scatter=error * spread,
        sizes=tuple(map(float, x)),
    )


def growth(found: Sequence[SizeSeries]) -> Section | None:
    """Test every series of at least four sizes; None where there is none."""
    tested = [series for series in found if len(series.sizes) >= SIZES]
    if not tested:
        return None
    return Section(
        name="growth",
        title="Do iterations grow?",
        prose=(
            "Scalable methods need as many iterations on a large problem as on a small "
            f"one. The hypothesis that they do not grow, p ≤ 0 in c·nᵖ, is tested at "
            f"{LEVEL:.0%} by Student's one-sided test of the slope on logarithms. That "
            "no growth is detected does not show that there is none: p may be as large "
            "as its upper bound (95 %, one-sided). Fewer than four sizes on which a "
            "solver is verified make no test.",
            "The time at the largest size is what the fit t = c·nᵖ says, with the 95 % "
            "interval of a further measurement; it is refused where the solver's own "
            "verified sizes end earlier, since nothing supports the law beyond them.",
        ),
        tables=tuple(map(_table, tested)),
    )


def _table(series: SizeSeries) -> Table:
    largest = series.sizes[-1][0]
    return Table(
        caption=f"Growth of iterations, and time at n = {largest}: {series.title}.",
        columns=(
            "solver", "sizes", "p of iterations", "p at most", "p-value",
            "iterations", f"time at n = {largest}",
        ),
        rows=tuple(_row(series, s, largest) for s in series.solvers),
    )  # fmt: skip


def _row(series: SizeSeries, solver: str, largest: int) -> tuple[Cell, ...]:
    curve = series.curve(solver)
    counted = [(n, sum(o.iterations) / 2) for n, o in curve if o.iterations]
    timed = [(n, t.value) for n, o in curve if (t := o.seconds("total"))]
    return (
        Cell(text=clean(solver, 40)),
        Cell(text=str(len(curve)), value=len(curve)),
        *_tested(_fit(counted)),
        _predicted(_fit(timed), largest),
    )


def _fit(points: Sequence[tuple[int, float]]) -> Growth | None:
    """Fit what is positive; None with too few sizes."""
    kept = [(n, v) for n, v in points if n > 0 and v > 0]
    if len({n for n, _ in kept}) < SIZES:
        return None
    return growth_of(*zip(*kept, strict=True))


def _tested(fit: Growth | None) -> tuple[Cell, ...]:
    if fit is None:
        few = Cell(text="too few sizes", kind="quiet")
        return (Cell(), Cell(), Cell(), few)
    p = "< 0.001" if fit.p_value < 0.001 else f"{fit.p_value:.3f}"
    return (
        Cell(text=f"{fit.exponent + 0.0:.3f}", value=fit.exponent),
        Cell(text=f"{fit.most + 0.0:.3f}", value=fit.most),
        Cell(text=p, value=fit.p_value),
        Cell(
            text="grow" if fit.grows else "no growth detected",
            kind="over" if fit.grows else "",
        ),
    )


def _predicted(fit: Growth | None, n: int) -> Cell:
    if fit is None:
        return Cell(text=ABSENT, title="fewer than four verified sizes")
    try:
        time = fit.at(n)
    except ValueError as e:
        return Cell(text="refused", kind="quiet", title=f"{e}")
    return Cell(text=seconds(time), value=time.value)
