"""The times of all solvers over that of the first, form by form, and who failed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from harness import Record
from reports.data.fastest import Competitor, FastestSolver, Finding, time_of
from reports.document.formatting import VERDICTS, clean, plural
from reports.figures.provenance import behind
from reports.figures.style import INK, STYLE, legible, log_ticks, look

PANELS = 4  #: forms that are drawn
SOLVERS = 12  #: of a panel
_NAME = 20  #: letters of a name beside an axis
_ROW = 0.3  #: height of a solver, inches
_BESIDE = 0.24  #: from a mean to the cases that it is of, rows
_TALL = 0.38  #: where ratios and a verdict share one, inches
_RAISED, _BELOW = 0.16, 0.32  #: of ratios above a verdict, and it below them, rows


def fastest_figure(
    found: Sequence[FastestSolver], solvers: Sequence[str]
) -> Figure | None:
    """Draw a panel per form and in it a row per solver; None without an answer.

    solvers : of the whole report, which their looks go by
    """
    panels = [f for f in found if f.cases and (f.competitors or f.others)]
    if not panels:
        return None
    columns = min(len(panels), 2)
    lines = -(-len(panels) // columns)
    heights = [
        0.75 + max(map(_height, panels[i : i + columns]))
        for i in range(0, len(panels), columns)
    ]
    with rc_context(STYLE):
        figure = Figure(figsize=(6.9, sum(heights)))
        grid = figure.subplots(
            lines, columns, squeeze=False, height_ratios=heights
        ).ravel()
        for axes, f in zip(grid, panels, strict=False):
            _panel(axes, f, solvers)
        _scale([a for a, f in zip(grid, panels, strict=False) if _has_reference(f)])
        for axes in grid[len(panels) :]:
            axes.set_axis_off()
    return figure


def _rows(f: FastestSolver) -> tuple[Competitor, ...]:
    return (*f.competitors, *f.others)[:SOLVERS]


def _height(f: FastestSolver) -> float:
    """Height of all rows, inches."""
    shared = _has_reference(f) and any(c.compared for c in f.others)
    return max(len(_rows(f)), 2) * (_TALL if shared else _ROW)


def _panel(axes: Axes, f: FastestSolver, solvers: Sequence[str]) -> None:
    """Draw the first solver uppermost, at 1, and everybody's ratios to it."""
    rows = _rows(f)
    for y, c in zip(range(len(rows) - 1, -1, -1), rows, strict=True):
        style = look(solvers.index(c.solver), line=False)
        failed = c in f.others
        below = _BELOW if failed and c.compared else 0.0
        if _has_reference(f):
            _draw(axes, y + _RAISED if below else y, c, f, style)
        if failed:
            axes.annotate(
                _failure(c), (0.995, y - below), xycoords=("axes fraction", "data"),
                ha="right", va="center", fontsize=8.5,
            )  # fmt: skip
    axes.set_title(f"{legible(f.kind.title)}, {plural(len(f.cases), 'case')}")
    names = [_short(c.solver) for c in rows]
    axes.set_yticks(range(len(rows) - 1, -1, -1), names)
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.tick_params(axis="y", length=0)
    axes.set_xscale("log")
    if _has_reference(f):
        axes.axvline(1.0, color=INK, linewidth=0.8, zorder=1)
        axes.set_xlabel(f"total time / that of {legible(f.first.solver)}")
    else:
        axes.set_xticks([])
        axes.set_xticks([], minor=True)
    axes.grid(visible=True, axis="x", color="#8a93a0", alpha=0.3, linewidth=0.4)
    axes.set_axisbelow(True)


def _short(name: str) -> str:
    """Leave out the middle of a long name, in letters that the font has."""
    text = clean(name)
    half = _NAME // 2 - 1
    return legible(text if len(text) <= _NAME else f"{text[:half]}..{text[-half:]}")


def _scale(panels: Sequence[Axes]) -> None:
    """Give all ratios one scale."""
    if not panels:
        return
    low, high = zip(*(axes.get_xlim() for axes in panels), strict=True)
    for axes in panels:
        axes.set_xlim(min(0.8, *low), max(2.0, *high))
        log_ticks(axes.xaxis)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))


def _has_reference(f: FastestSolver) -> bool:
    return bool(f.competitors) and f.finding is not Finding.ENVIRONMENTS


def _draw(
    axes: Axes, y: float, c: Competitor, f: FastestSolver, style: dict[str, Any]
) -> None:
    """Draw the ratios of one solver to the first, case by case and over the cases."""
    if c is f.first:
        _points(axes, [1.0], [y], [_behind(c, f.cases)], style)
        return
    count = len(c.compared)
    middle = c.ratio if f.over_cases else None
    spread = np.linspace(0.25, -0.25, count) if count > 1 else np.zeros(count)
    places = np.full(count, y + (_BESIDE if middle else 0.0))
    places += 0 if f.over_cases else spread
    small = {**style, "markersize": 2.8, "alpha": 0.6} if f.over_cases else style
    ratios = [_ratio(c, f.first, case) for case in c.compared]
    _points(axes, ratios, places, [_behind(c, [case]) for case in c.compared], small)
    bars = [
        (c.by_case[case], place)
        for case, place in zip(c.compared, places, strict=True)
        if case in c.by_case
    ]
    if middle:
        _points(axes, [middle.value], [y], [_behind(c, c.compared)], style)
        bars.append((middle, y))
    for ratio, place in bars:
        axes.hlines(place, ratio.low, ratio.high, color=style["color"], linewidth=1.1)


def _behind(c: Competitor, cases: Iterable[str]) -> list[Record]:
    return [r for case in cases for r in c.outcomes[case].records]


def _ratio(c: Competitor, first: Competitor, case: str) -> float:
    """Ratio of a case: within blocks where there are some, else of the medians."""
    if case in c.by_case:
        return c.by_case[case].value
    mine, its = time_of(c.outcomes[case]), time_of(first.outcomes[case])
    return mine / its if mine and its else np.nan


def _points(
    axes: Axes, x: Any, y: Any, runs: Sequence[Any], style: dict[str, Any]
) -> None:
    (line,) = axes.plot(x, y, **style)
    behind(line, runs)


def _failure(c: Competitor) -> str:
    """Say which verdict most of the answers ended in that were not verified."""
    count = Counter(o.verdict for o in c.outcomes.values() if time_of(o) is None)
    if not count:
        return ""
    verdict, n = count.most_common(1)[0]
    _, words = VERDICTS[verdict]
    return (
        words if n == len(c.outcomes) == 1 else f"{words} on {n} of {len(c.outcomes)}"
    )
