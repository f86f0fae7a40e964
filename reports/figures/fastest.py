"""The times of all solvers over that of the first, form by form, and who failed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from reports.data.fastest import Competitor, FastestSolver, Finding, time_of
from reports.document.formatting import VERDICTS, plural
from reports.figures.provenance import behind
from reports.figures.style import INK, STYLE, legible, log_ticks, look

PANELS = 4  #: forms that are drawn
SOLVERS = 12  #: of a panel
_ROW = 0.3  #: height of a solver, inches
_APART = 0.3  #: from what is in the middle of a row to what is beside it, rows


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
    rows = [
        max(len(_rows(f)) for f in panels[i : i + columns])
        for i in range(0, len(panels), columns)
    ]
    heights = [0.75 + _ROW * max(n, 2) for n in rows]
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


def _panel(axes: Axes, f: FastestSolver, solvers: Sequence[str]) -> None:
    """Draw the first solver uppermost, at 1, and everybody's ratios to it."""
    rows = _rows(f)
    for y, c in zip(range(len(rows) - 1, -1, -1), rows, strict=True):
        style = look(solvers.index(c.solver), line=False)
        drawn = _draw(axes, y, c, f, style) if _has_reference(f) else False
        if c in f.others:
            beside = y + _APART if drawn else y
            axes.annotate(
                _failure(c), (0.995, beside), xycoords=("axes fraction", "data"),
                ha="right", va="center", fontsize=8.5,
            )  # fmt: skip
    axes.set_title(f"{legible(f.kind.title)}, {plural(len(f.cases), 'case')}")
    names = [legible(c.solver) for c in rows]
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


def _scale(panels: Sequence[Axes]) -> None:
    """Give all ratios one scale."""
    if not panels:
        return
    low, high = zip(*(axes.get_xlim() for axes in panels), strict=True)
    for axes in panels:
        axes.set_xlim(min(0.8, *low), max(2.0, *high))
        log_ticks(axes.xaxis)


def _has_reference(f: FastestSolver) -> bool:
    return bool(f.competitors) and f.finding is not Finding.ENVIRONMENTS


def _draw(
    axes: Axes, y: int, c: Competitor, f: FastestSolver, style: dict[str, Any]
) -> bool:
    """Draw the ratios of one solver to the first; tell whether there are any."""
    both = [case for case in c.verified if case in c.outcomes]
    if not both:
        return False
    if c is f.first:
        _points(
            axes,
            [1.0],
            [y],
            [[r for o in c.outcomes.values() for r in o.records]],
            style,
        )
        return True
    ratios = np.array([_ratio(c, f.first, case) for case in both])
    middle = c.ratio if f.over_cases else None
    at = np.full(ratios.size, y - (_APART if middle else 0.0))
    if not f.over_cases and ratios.size > 1:
        at = at + np.linspace(0.25, -0.25, ratios.size)
    small = {**style, "markersize": 2.8, "alpha": 0.6} if f.over_cases else style
    _points(axes, ratios, at, [c.outcomes[case].records for case in both], small)
    spans = [
        (c.by_case[case].low, c.by_case[case].high, place)
        for case, place in zip(both, at, strict=True)
        if case in c.by_case
    ]
    if middle:
        runs = [r for case in both for r in c.outcomes[case].records]
        _points(axes, [middle.value], [y], [runs], style)
        spans.append((middle.low, middle.high, y))
    if spans:
        low, high, places = np.array(spans).T
        axes.hlines(places, low, high, color=style["color"], linewidth=1.1)
    return True


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
