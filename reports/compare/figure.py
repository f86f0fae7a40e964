"""Ratios of times after over before, drawn solver by solver."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator

from reports.compare.changes import Comparison, Pair, mean_ratio
from reports.figures.style import INK, STYLE, legible, look

_ROW = 0.42  #: height of a solver's row, inches


def ratios_figure(c: Comparison) -> Figure:
    """Draw a row per solver: its cells as dots, its mean as a bar with its interval."""
    solvers = [s for s in c.solvers if any(p.logs for p in c.of(s))]
    with rc_context(STYLE):
        figure = Figure(figsize=(6.9, 0.8 + _ROW * max(len(solvers), 1)))
        axes = figure.subplots()
        for row, solver in enumerate(solvers):
            colour = look(c.after.solvers.index(solver))["color"]
            _row(axes, row, [p for p in c.of(solver) if p.logs], colour)
        axes.axvline(1.0, color=INK, linewidth=0.8, zorder=1)
        axes.set_xscale("log")
        axes.set_yticks(range(len(solvers)), [legible(s) for s in solvers])
        axes.set_ylim(len(solvers) - 0.4, -0.6)
        axes.set_xlabel("time after / time before")
        axes.grid(visible=True, axis="x", color="#8a93a0", alpha=0.3, linewidth=0.4)
        axes.tick_params(axis="y", length=0)
        _ticks(axes)
    return figure


def _row(axes: Axes, row: int, pairs: list[Pair], colour: str) -> None:
    """Draw the cells of one solver above its mean."""
    ratios = np.exp([np.mean(p.logs) for p in pairs])
    changed = np.array([p.change != 0 for p in pairs])
    y = np.full(ratios.size, row - 0.16)
    style: dict[str, Any] = {
        "marker": "o",
        "linestyle": "none",
        "color": colour,
        "markersize": 4,
    }
    axes.plot(ratios[~changed], y[~changed], markerfacecolor="none", **style)
    axes.plot(ratios[changed], y[changed], **style)
    mean = mean_ratio(pairs)
    if mean is None:
        return
    if mean.low > 0:
        axes.plot([mean.low, mean.high], [row + 0.16] * 2, color=colour, linewidth=2.2)
    axes.plot([mean.value], [row + 0.16], "|", color=INK, markersize=9)


def _ticks(axes: Axes) -> None:
    """Write ratios as plain numbers, a few of them, and 1 in any case."""
    low, high = axes.get_xlim()
    low, high = min(low, 1 / 1.1), max(high, 1.1)
    axes.set_xlim(low, high)
    narrow = np.log10(high / low) < 0.8
    few = MaxNLocator(6, steps=[1, 2, 2.5, 5, 10])
    axes.xaxis.set_major_locator(few if narrow else LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axes.minorticks_off()
