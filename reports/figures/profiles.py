"""Figures of performance and data profiles."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mortarbench.reports.data.aggregation import Ranking
from mortarbench.reports.document.figure import (
    INK,
    Area,
    Axis,
    Figure,
    Look,
    Mark,
    Panel,
    Row,
    Series,
    in_rows,
    numbers,
)
from mortarbench.reports.document.formatting import plural
from mortarbench.reports.figures.style import (
    LEGEND_LINE,
    TITLE,
    below,
    legible,
    look,
    solver_keys,
    with_legend,
)
from mortarbench.reports.statistics.profiles import Array, curve, performance_ratios

ROW = 4  #: largest number of solvers in colour in one panel
ROWS = 4  #: `ROW`·`ROWS` solvers are coloured; the others are grey in every row
PAIRS = 6  #: largest number of pairwise panels
BANDED = 20  #: minimum number of cases for bands if three or more solvers are drawn
_COLUMNS = 3  #: number of columns of pairwise panels
_GREY = Look(colour="#d3d7dc", width=0.5)
_COARSE = 60  #: number of points of a grey curve; there may be hundreds of curves

#: ticks by the largest ratio on an axis; longer axes have powers of ten
_FACTORS = {
    3.5: (1, 1.5, 2, 3),
    15.0: (1, 2, 5, 10),
    60.0: (1, 2, 5, 10, 20, 50),
}

_SHARES = Axis(
    low=0, high=1.03, ticks=((0, "0.0"), (0.5, "0.5"), (1, "1.0")), shared="shares"
)

Ends = tuple[float, float]  #: ends of an axis


def rows_of(ranking: Ranking, solvers: Sequence[str]) -> list[list[int]]:
    """Distribute the first `ROW`·`ROWS` solvers by rank over rows of distinct colours.

    solvers : all solvers of the report, whose order determines colours and markers
    """
    rows: list[dict[str, int]] = []
    for i in map(int, ranking.order[: ROW * ROWS]):
        colour = look(solvers.index(ranking.group.solvers[i])).colour
        free = (row for row in rows if len(row) < ROW and colour not in row)
        row = next(free, None)
        if row is None:
            row = {}
            rows.append(row)
        row[colour] = i
    return [list(row.values()) for row in rows]


def rivals(ranking: Ranking) -> list[int]:
    """Select the solvers compared pairwise with the leader: the next by rank."""
    return [int(i) for i in ranking.order[1 : PAIRS + 1]]


def banded(ranking: Ranking) -> bool:
    """Return whether `profile_figure` has bands; `pairwise_figure` always has bands."""
    group = ranking.group
    return len(group.solvers) <= 2 or len(group.cases) >= BANDED


def profile_figure(ranking: Ranking, solvers: Sequence[str]) -> Figure:
    """Plot performance and data profiles; each row of panels colours some solvers."""
    group = ranking.group
    ratios = performance_ratios(group.times)
    solved = group.times[group.solved]
    span = (float(solved.min()) / 1.3, 1.3 * float(solved.max()))
    factors, times = (1.0, _end(ratios)), span
    coloured = rows_of(ranking, solvers)
    rows = []
    for mine in coloured:
        last = mine is coloured[-1]
        names = [group.solvers[i] for i in mine]
        others = sorted(set(range(len(group.solvers))) - set(mine))
        left, right = list[Mark](), list[Mark]()
        for values, ends, marks in (ratios, factors, left), (group.times, times, right):
            marks += [_grey(values[:, i], ends, group.solvers[i]) for i in others]
            for i, name in zip(mine, names, strict=True):
                style, band = look(solvers.index(name)), banded(ranking)
                marks += _profile(values[:, i], ends, style, name, band=band)
        panels = (
            _panel(_factors("time / best time for the case" * last, factors), left),
            _panel(_log("time in s" * last, times), right, first=False),
        )
        keys = solver_keys(names, solvers)
        # the last row also has the labels of the axes
        height = 1.9 + LEGEND_LINE * (2 if last else 1)
        rows.append(Row(panels=panels, height=height, legend=below(keys, ROW)))
    return Figure(
        rows=tuple(rows),
        height=TITLE + sum(row.height for row in rows),
        title=legible(_title(ranking), 96),
    )


def pairwise_figure(ranking: Ranking, solvers: Sequence[str]) -> Figure:
    """Plot pairwise performance profiles of the leader, in black, and each rival."""
    group, leader = ranking.group, ranking.leader
    against = rivals(ranking)
    names = [group.solvers[i] for i in (leader, *against)]
    styles = [look(solvers.index(name)) for name in names]
    styles[0] = replace(styles[0], colour=INK)
    columns = min(len(against), _COLUMNS)
    panels = []
    for n, rival in enumerate(against):
        ratios = performance_ratios(group.times[:, [leader, rival]])
        ends = (1.0, _end(ratios))
        lowest = n + columns >= len(against)
        axis = _factors("time / better of the two" * lowest, ends)
        marks = _profile(ratios[:, 1], ends, styles[n + 1], names[n + 1])
        marks += _profile(ratios[:, 0], ends, styles[0], names[0])
        panels.append(_panel(axis, marks, first=n % columns == 0))
    rows = in_rows(panels, columns)
    first, *others = solver_keys(names, solvers)
    keys = [replace(first, look=styles[0]), *others]
    height = 1.75 * len(rows) + LEGEND_LINE
    return with_legend(rows, keys, ROW, height, _title(ranking))


def _title(ranking: Ranking) -> str:
    """Return form, accuracy and number of cases, and the family if it is unique."""
    group = ranking.group
    families = Counter(case.partition("/")[0] for case in group.cases)
    of = f" of {next(iter(families))}" if len(families) == 1 else ""
    return f"{group.title}, {plural(len(group.cases), 'case')}{of}"


def _end(ratios: Array) -> float:
    """Return the end of an axis of ratios, slightly beyond the largest finite one."""
    return float(max(2.0, 1.1 * ratios[np.isfinite(ratios)].max()))


def _grey(values: Array, ends: Ends, solver: str) -> Series:
    """Return the grey profile of a solver that is not coloured in this row."""
    at, share = curve(values, *ends, points=_COARSE)
    return Series(
        x=numbers(at), y=numbers(share.value), look=_GREY, step=True, solver=solver
    )


def _profile(
    values: Array, ends: Ends, style: Look, solver: str, *, band: bool = True
) -> list[Mark]:
    """Return the band of a profile, if any, and its step function with few markers."""
    at, share = curve(values, *ends)
    x = numbers(at)
    line = Series(
        x=x,
        y=numbers(share.value),
        look=style,
        step=True,
        few=True,
        clipped=False,
        solver=solver,
    )
    if not band:
        return [line]
    low, high = numbers(share.low), numbers(share.high)
    around = Area(
        x=x,
        low=low,
        high=high,
        colour=style.colour,
        opacity=0.11,
        step=True,
        solver=solver,
    )
    return [around, line]


def _panel(axis: Axis, marks: Sequence[Mark], *, first: bool = True) -> Panel:
    shares = replace(_SHARES, label="share of cases" * first, numbered=first)
    return Panel(x=axis, y=shares, marks=tuple(marks))


def _log(label: str, ends: Ends) -> Axis:
    return Axis(label=label, log=True, low=ends[0], high=ends[1])


def _factors(label: str, ends: Ends) -> Axis:
    """Return a logarithmic axis of ratios that starts at 1, with round ticks."""
    for last, ticks in _FACTORS.items():
        if ends[1] <= last:
            return replace(_log(label, ends), ticks=tuple((t, f"{t:g}") for t in ticks))
    return _log(label, ends)
