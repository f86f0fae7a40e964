"""Time and memory from the mesh to a verified answer against size, for every route."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import sqrt

from mortarbench.harness import Verdict
from mortarbench.reports.data.crossover import KINDS, Map, Route, charged, memory
from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.document.figure import (
    INK,
    Figure,
    Key,
    Look,
    Mark,
    Panel,
    Row,
    Rule,
    Text,
)
from mortarbench.reports.figures.style import (
    COLOURS,
    DASHED,
    DOTTED,
    MARKERS,
    curve,
    legible,
    log,
    with_legend,
)
from mortarbench.reports.statistics.intervals import Interval

#: letters at the end of a line, by the verdict at the next size; "?": not measured
LETTERS = {
    Verdict.TIME_LIMIT: "t",
    Verdict.MEMORY_LIMIT: "m",
    Verdict.ITERATION_LIMIT: "i",
    Verdict.DECLINED: "d",
}
FAILED = "f"  #: letter of all other verdicts
UNMEASURED = "?"
_HEIGHT = 2.75  #: height of a row of panels, inches
_LETTER = 1.7  #: letters overlap below this ratio of values on an axis of four decades
_LIMIT = Look(colour=INK, width=0.7, dash=DOTTED)
_BARS = {"cap": 2.2, "width": 0.9}

Quantity = Callable[[Outcome], Interval | None]


def crossover_figure(
    maps: Sequence[Map], time_limit: float | None, memory_limit: float | None
) -> Figure:
    """Plot times (left) and peak memory (right) of all routes, one row per map.

    time_limit, memory_limit : s and MiB, drawn as dotted lines; None if unknown
    """
    rows = []
    for one in maps:
        title = legible(one.title, 44)
        panels = (
            _panel(one, charged, "time from mesh to answer in s", time_limit, title),
            # omit letters, because the peaks of several routes are close together
            replace(
                _panel(one, memory, "peak memory in MiB", memory_limit, title),
                texts=(),
            ),
        )
        rows.append(Row(panels=panels))
    routes = dict.fromkeys(r for one in maps for r in one.routes if one.routes[r])
    ordered = sorted(routes, key=lambda r: (_index(r), r.layout, r.ranks))
    keys = [
        Key(label=legible(label, 40), look=_look(route), solver=label)
        for route in ordered
        if (label := _short(route))
    ]
    keys = list({key.label: key for key in keys}.values())
    return with_legend(rows, keys, 3, _HEIGHT * len(rows))


def _panel(
    one: Map, quantity: Quantity, label: str, limit: float | None, title: str
) -> Panel:
    marks, ends = list[Mark](), list[tuple[int, float, str]]()
    for route, answers in one.routes.items():
        points = [(n, quantity(o), o) for n, o in answers.items()]
        known = [(n, value) for n, value, _ in points if value is not None]
        marks += curve(points, _look(route), _short(route), _BARS)
        letter = end_letter(one, route)
        if known and letter:
            n, last = known[-1]
            ends.append((n, last.value, letter))
    rules = () if limit is None else (Rule(axis="y", at=float(limit), look=_LIMIT),)
    return Panel(
        x=log("degrees of freedom"),
        y=log(label),
        marks=tuple(marks),
        texts=_letters(ends),
        rules=rules,
        title=title,
    )


def _letters(ends: Sequence[tuple[int, float, str]]) -> tuple[Text, ...]:
    """Return texts with the letters at (dofs, value); join letters that overlap."""
    groups = list[list[tuple[int, float, str]]]()
    for end in sorted(ends):
        last = groups[-1][-1] if groups else (0, 0.0, "")
        if end[0] == last[0] and end[1] <= _LETTER * last[1]:
            groups[-1].append(end)
        else:
            groups.append([end])
    return tuple(
        Text(
            text=", ".join(sorted({letter for *_, letter in group})),
            place=(group[0][0], sqrt(group[0][1] * group[-1][1])),
            offset=(6, 0),
        )
        for group in groups
    )


def end_letter(one: Map, route: Route) -> str:
    """Return the letter at the end of a route; empty if it reached the largest size."""
    stop = one.stops[route]
    if stop.dofs is None:
        return ""
    if stop.verdict is None:
        return UNMEASURED
    return LETTERS.get(stop.verdict, FAILED)


def _index(route: Route) -> int:
    return KINDS.index(route.kind) if route.kind in KINDS else len(KINDS)


def _short(route: Route) -> str:
    """Return the name of a route without the keys of its decomposition.

    Families differ in the keys of the same kind of route; the tables show the keys.
    """
    return route._replace(layout="").label


def _look(route: Route) -> Look:
    """Return the style of a route by its kind; dashed and hollow for several ranks."""
    i = _index(route)
    style = Look(colour=COLOURS[i], marker=MARKERS[i], width=1.3, size=4.2)
    if route.ranks == 1:
        return style
    return replace(style, dash=DASHED, fill="none")
