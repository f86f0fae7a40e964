"""Total time and iterations against size."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from reports.data.size_series import SizeSeries
from reports.document.formatting import exponent
from reports.figures.provenance import behind
from reports.figures.style import INK, LEGEND_LINE, STYLE, legible, log_log, look


def scaling_figure(series: SizeSeries, solvers: Sequence[str]) -> Figure:
    """Draw total time and iterations against n on logarithmic axes."""
    with rc_context(STYLE):
        entries = -(-len(series.solvers) // 2)  # lines of the legend
        figure = Figure(figsize=(6.9, 2.4 + LEGEND_LINE * max(entries, 3)))
        left, right = figure.subplots(1, 2)
        for solver in series.solvers:
            style = look(solvers.index(solver))
            _times(left, series, solver, style=style)
            counted = [
                (n, sum(o.iterations) / 2, o.records)
                for n, o in series.curve(solver)
                if o.iterations is not None
            ]
            if counted:
                n, its, runs = zip(*counted, strict=True)
                (line,) = right.plot(n, its, **style)
                behind(line, runs)
        log_log(left, "degrees of freedom $n$", "total time in s")
        _slopes(left)
        log_log(right, "degrees of freedom $n$", "iterations")
        handles, labels = left.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def _times(
    axes: Axes, series: SizeSeries, solver: str, *, style: dict[str, Any]
) -> None:
    """Plot medians with their intervals, and the exponent in the legend."""
    timed = [(n, o.seconds("total")) for n, o in series.curve(solver)]
    points = [(n, t.value, t.low, t.high) for n, t in timed if t is not None]
    if not points:
        return
    n, t, low, high = np.array(points, dtype=float).T
    runs = [o.records for _, o in series.curve(solver) if o.seconds("total")]
    law = series.time_law(solver)
    label = legible(solver) + (f",  p = {exponent(law)}" if law else "")
    (line,) = axes.plot(n, t, label=label, **style)
    _, caps, bars = axes.errorbar(
        n, t, yerr=[t - low, high - t], fmt="none", color=style["color"], capsize=2,
        elinewidth=0.7,
    )  # fmt: skip
    for artist in (line, *caps, *bars):
        behind(artist, runs)


def _slopes(axes: Axes) -> None:
    """Draw guides of slopes 1 and 3/2 through the lower right of the plot."""
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    start, stop = x0 * (x1 / x0) ** 0.62, x0 * (x1 / x0) ** 0.9
    base = y0 * (y1 / y0) ** 0.04
    for slope, name in ((1.0, "$n$"), (1.5, "$n^{3/2}$")):
        end = base * (stop / start) ** slope
        axes.plot([start, stop], [base, end], color=INK, linewidth=0.6, zorder=1)
        axes.annotate(
            name, (stop, end), xytext=(2, 0), textcoords="offset points", va="center",
            fontsize=8.5,
        )  # fmt: skip
    axes.set(xlim=(x0, x1), ylim=(y0, y1))
