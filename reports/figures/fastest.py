"""Times relative to the fastest solver, for each form, and failures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from mortarbench.harness.running.pairs import Ratio
from mortarbench.reports.data.comparison_groups import time_of
from mortarbench.reports.data.evidence import case_set
from mortarbench.reports.data.fastest import Competitor, FastestSolver
from mortarbench.reports.document.figure import (
    INK,
    Axis,
    Figure,
    Look,
    Mark,
    Panel,
    Row,
    Rule,
    Text,
    categories,
    limits,
)
from mortarbench.reports.document.formatting import VERDICTS, clean
from mortarbench.reports.figures.style import curve, legible, look

PANELS = 4  #: largest number of forms in a figure
SOLVERS = 12  #: largest number of solvers in a panel
_NAME = 28  #: largest number of characters of a name beside an axis
_CASES = 88  #: largest number of characters of the cases in the titles of a row
_ROW = 0.3  #: height of a row, inches
_BESIDE = 0.24  #: distance between a mean and the ratios of its cases, rows
_TALL = 0.38  #: height of rows with ratios and a verdict, inches
_RAISED, _BELOW = (
    0.16,
    0.32,
)  #: offset of the ratios above the middle of a row, and of a verdict below it, in rows
_BARS = {"cap": 0.0, "width": 1.1}
_ALIKE = Look(colour=INK, width=0.8)  #: line of equal times


def fastest_figure(
    found: Sequence[FastestSolver], solvers: Sequence[str], most: int = SOLVERS
) -> Figure | None:
    """Draw a panel per form with a row per solver; None if there are no answers.

    solvers : all solvers of the report, whose order determines colours and markers
    most : largest number of rows in a panel
    """
    shown = [f for f in found if f.cases and (f.competitors or f.others)]
    if not shown:
        return None
    columns = min(len(shown), 2)
    panels = _on_one_scale([_panel(f, solvers, most, _CASES // columns) for f in shown])
    rows = []
    for i in range(0, len(shown), columns):
        height = 0.75 + max(_height(f, most) for f in shown[i : i + columns])
        rows.append(Row(panels=tuple(panels[i : i + columns]), height=height))
    return Figure(rows=tuple(rows), height=sum(row.height for row in rows))


def _rows(f: FastestSolver, most: int) -> tuple[Competitor, ...]:
    """Return at most `most` solvers: the first ones, and the best one of each form."""
    every = (*f.competitors, *f.others)
    best = {c.form: c for c in reversed(every)}.values()
    late = [c for c in every[most:] if any(c is one for one in best)]
    return (*every[: most - len(late)], *late)


def _height(f: FastestSolver, most: int) -> float:
    """Return the height of all rows, inches."""
    shared = f.competitors and any(c.compared for c in f.others)
    return max(len(_rows(f, most)), 4) * (_TALL if shared else _ROW)


def _panel(f: FastestSolver, solvers: Sequence[str], most: int, length: int) -> Panel:
    """Draw times relative to the fastest solver, which is in the top row.

    length : largest number of characters of the cases in the title
    """
    marks: list[Mark] = []
    texts = []
    for k, c in enumerate(_rows(f, most)):
        style = replace(look(solvers.index(c.solver)), dash=None)
        failed = c in f.others
        below = _BELOW if failed and c.compared else 0.0
        if f.competitors:
            marks += _marks(_RAISED - k if below else -float(k), c, f, style)
        if failed:
            texts.append(
                Text(
                    text=_failure(c),
                    place=(0.995, -k - below),
                    inside=(True, False),
                    align=("right", "center"),
                )
            )
    return Panel(
        x=_ratios(f),
        y=categories([_short(_name(c)) for c in _rows(f, most)]),
        marks=tuple(marks),
        rules=(Rule(axis="x", at=1.0, look=_ALIKE),) if f.competitors else (),
        texts=tuple(texts),
        title=f"{legible(f.key.title)}, {legible(_cases(f), length)}",
        grid="x",
    )


def _cases(f: FastestSolver) -> str:
    row = (*f.competitors, *f.others)[0].outcomes
    noun = "problem" if any(c.form for c in f.competitors) else "case"
    return case_set((row[case] for case in f.cases), noun)


def _ratios(f: FastestSolver) -> Axis:
    if not f.competitors:
        return Axis(low=0.0, high=1.0, ticks=())
    time = "time from the mesh" if f.first.form else "time"
    label = f"{time} relative to {legible(_name(f.first), 44)}"
    return Axis(label=label, log=True, plain=True, span=2.0, shared="ratios")


def _name(c: Competitor) -> str:
    return f"{c.solver}, {c.form}" if c.form else c.solver


def _short(name: str) -> str:
    """Abbreviate a long name in the middle; replace characters missing in the font."""
    text = clean(name)
    half = _NAME // 2 - 1
    return legible(text if len(text) <= _NAME else f"{text[:half]}..{text[-half:]}")


def _on_one_scale(panels: Sequence[Panel]) -> list[Panel]:
    """Scale the ratios of all panels equally, on an axis that contains 0.8 and 2."""
    ratios = [p for p in panels if p.x.log]
    if not ratios:
        return list(panels)
    low, high = limits(ratios, "x")
    low, high = min(0.8, low), max(2.0, high)
    return [
        replace(p, x=replace(p.x, low=low, high=high)) if p.x.log else p for p in panels
    ]


def _marks(y: float, c: Competitor, f: FastestSolver, style: Look) -> list[Mark]:
    """Mark the ratios of one solver to the fastest, by case and over all cases."""
    if c is f.first:
        return [*curve([(1.0, y, _behind(c, f.cases))], style, c.solver, clipped=False)]
    count = len(c.compared)
    middle = c.ratio if f.over_cases else None
    spread = np.linspace(0.25, -0.25, count) if count > 1 else np.zeros(count)
    places = np.full(count, y + (_BESIDE if middle else 0.0))
    places += 0 if f.over_cases else spread
    small = replace(style, size=2.8, opacity=0.6) if f.over_cases else style
    cases = [
        (_ratio(c, f, case), place, _behind(c, [case]))
        for case, place in zip(c.compared, places, strict=True)
    ]
    over = (middle, y, _behind(c, c.compared))
    return [
        *curve(cases, small, c.solver, _BARS, clipped=False),
        *curve([over], style, c.solver, _BARS, clipped=False),
    ]


def _behind(c: Competitor, cases: Iterable[str]) -> tuple[str, ...]:
    """Return the run_ids of a solver on `cases`."""
    return tuple(name for case in cases for name in c.outcomes[case].run_ids)


def _ratio(c: Competitor, f: FastestSolver, case: str) -> Ratio | float:
    """Return the ratio of medians if cases are averaged, else the ratio by blocks."""
    if case in c.by_case and not f.over_cases:
        return c.by_case[case]
    mine, its = time_of(c.outcomes[case]), time_of(f.first.outcomes[case])
    return mine / its if mine and its else np.nan


def _failure(c: Competitor) -> str:
    """Return the most frequent verdict of unverified answers, with its count."""
    if c.remembers:
        return "reuses answers"
    count = Counter(o.verdict for o in c.outcomes.values() if time_of(o) is None)
    if not count:
        return ""
    verdict, n = count.most_common(1)[0]
    _, words = VERDICTS[verdict]
    return (
        words if n == len(c.outcomes) == 1 else f"{words} on {n} of {len(c.outcomes)}"
    )
