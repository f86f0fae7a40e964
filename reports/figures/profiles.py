"""Pictures of performance and data profiles, for two solvers and for fifty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D

from reports.data.aggregation import Ranking
from reports.figures.style import INK, LEGEND_LINE, STYLE, legible, log_ticks, look
from reports.statistics.profiles import Array, Curve, curve, performance_ratios

ROW = 4  #: solvers that are told apart in one panel, with their bands
ROWS = 4  #: of panels; further solvers are grey in all of them
PAIRS = 6  #: panels of two solvers
BANDED = 20  #: cases; with fewer, bands of more than two solvers hide each other
_COLUMNS = 3  #: of those
_GREY = "#d3d7dc"
_COARSE = 60  #: points of a grey curve, of which there may be hundreds

#: up to which ratio to use which ticks; beyond, powers of ten
_FACTORS = {
    3.5: (1, 1.5, 2, 3),
    15.0: (1, 2, 5, 10),
    60.0: (1, 2, 5, 10, 20, 50),
}

Place = tuple[float, float]  #: ends of an axis


def rows_of(ranking: Ranking, solvers: Sequence[str]) -> list[list[int]]:
    """Share the solvers out among rows, best means first, no colour twice in a row.

    solvers : of the whole report, which their looks go by
    """
    rows: list[dict[str, int]] = []
    for i in map(int, ranking.order[: ROW * ROWS]):
        colour = look(solvers.index(ranking.group.solvers[i]))["color"]
        free = (row for row in rows if len(row) < ROW and colour not in row)
        row = next(free, None)
        if row is None:
            row = {}
            rows.append(row)
        row[colour] = i
    return [list(row.values()) for row in rows]


def rivals(ranking: Ranking) -> list[int]:
    """Choose the solvers that the leader is paired with: the next in that order."""
    return [int(i) for i in ranking.order[1 : PAIRS + 1]]


def banded(ranking: Ranking) -> bool:
    """Whether `profile_figure` has bands; `pairwise_figure` always has."""
    group = ranking.group
    return len(group.solvers) <= 2 or len(group.cases) >= BANDED


def profile_figure(ranking: Ranking, solvers: Sequence[str]) -> Figure:
    """Draw both profiles of every solver, a few in colour in each row of panels."""
    group = ranking.group
    ratios = performance_ratios(group.times)
    known = group.times[group.solved]
    span = (float(known.min()) / 1.3, 1.3 * float(known.max()))
    sides = (
        (ratios, (1.0, _end(ratios)), "time / best time of the case"),
        (group.times, span, "time in s"),
    )
    rows = rows_of(ranking, solvers)
    heights = [1.9 + LEGEND_LINE] * len(rows)
    heights[-1] += LEGEND_LINE  # for the labels of the axes
    with rc_context(STYLE):
        figure = Figure(figsize=(6.9, sum(heights)))
        parts = figure.subfigures(len(rows), 1, height_ratios=heights, squeeze=False)
        for part, mine in zip(parts[:, 0], rows, strict=True):
            panels = part.subplots(1, 2, sharey=True)
            for axes, (values, ends, name) in zip(panels, sides, strict=True):
                _others(axes, values, mine, ends)
                for i in mine:
                    style = look(solvers.index(group.solvers[i]))
                    drawn = curve(values[:, i], *ends)
                    _profile(axes, drawn, style, band=banded(ranking))
                _dress(axes, ends, name if mine is rows[-1] else "")
                if values is ratios:
                    _factors(axes, ends[1])
            panels[0].set_ylabel("share of cases")
            names = [group.solvers[i] for i in mine]
            _legend(part, names, [look(solvers.index(name)) for name in names])
    return figure


def pairwise_figure(ranking: Ranking, solvers: Sequence[str]) -> Figure:
    """Draw performance profiles of two: the leader, in black, and each next rival."""
    group, leader = ranking.group, ranking.leader
    against = rivals(ranking)
    names = [group.solvers[i] for i in (leader, *against)]
    styles = [look(solvers.index(name)) for name in names]
    styles[0] |= {"color": INK}
    columns = min(len(against), _COLUMNS)
    lines = -(-len(against) // columns)
    with rc_context(STYLE):
        legend = LEGEND_LINE * (1 + -(-len(names) // ROW))
        figure = Figure(figsize=(6.9, 1.75 * lines + legend))
        grid = figure.subplots(lines, columns, sharey=True, squeeze=False)
        for n, axes in enumerate(grid.ravel()):
            if n >= len(against):
                axes.set_axis_off()
                continue
            ratios = performance_ratios(group.times[:, [leader, against[n]]])
            ends = (1.0, _end(ratios))
            _profile(axes, curve(ratios[:, 1], *ends), styles[n + 1])
            _profile(axes, curve(ratios[:, 0], *ends), styles[0])
            lowest = n + columns >= len(against)
            _dress(axes, ends, "time / better of the two" if lowest else "")
            _factors(axes, ends[1])
        for axes in grid[:, 0]:
            axes.set_ylabel("share of cases")
        _legend(figure, names, styles)
    return figure


def _end(ratios: Array) -> float:
    """Choose where an axis of ratios ends: a little after the largest finite one."""
    return float(max(2.0, 1.1 * ratios[np.isfinite(ratios)].max()))


def _others(axes: Axes, values: Array, mine: Sequence[int], ends: Place) -> None:
    """Draw all the other solvers in grey, behind."""
    for i in set(range(values.shape[1])) - set(mine):
        at, share = curve(values[:, i], *ends, points=_COARSE)
        axes.step(at, share.value, where="post", color=_GREY, linewidth=0.5, zorder=1)


def _profile(
    axes: Axes, drawn: Curve, style: dict[str, Any], *, band: bool = True
) -> None:
    """Draw a step function with few markers, and its band."""
    at, share = drawn
    if band:
        axes.fill_between(
            at, share.low, share.high, step="post", color=style["color"], alpha=0.11,
            linewidth=0,
        )  # fmt: skip
    axes.step(
        at, share.value, where="post", markevery=(0.07, 0.19), clip_on=False, **style
    )


def _dress(axes: Axes, ends: Place, label: str) -> None:
    axes.set(xscale="log", xlim=ends, ylim=(0, 1.03), yticks=[0, 0.5, 1], xlabel=label)
    axes.grid(visible=True, color="#8a93a0", alpha=0.3, linewidth=0.4)
    axes.set_axisbelow(True)
    log_ticks(axes.xaxis)


def _factors(axes: Axes, stop: float) -> None:
    """Label an axis of ratios, which begins at 1, as one says them."""
    for last, ticks in _FACTORS.items():
        if stop <= last:
            axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
            axes.set_xticks([], minor=True)
            axes.set_xlim(1, stop)
            return


def _legend(
    figure: Figure | SubFigure, names: Sequence[str], styles: Sequence[dict[str, Any]]
) -> None:
    keys = [Line2D([], [], **style) for style in styles]
    labels = [legible(name) for name in names]
    figure.legend(keys, labels, loc="outside lower center", ncols=ROW)
