"""Error against time, and sweeps of tolerances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import isfinite
from typing import Any

from mortarbench.reports.data.evidence import Evidence, Outcome, shared
from mortarbench.reports.data.time_at_accuracy import SMALLEST, counts
from mortarbench.reports.document.figure import (
    INK,
    Figure,
    Key,
    Legend,
    Look,
    Panel,
    Row,
    Rule,
    Series,
    Text,
    in_rows,
)
from mortarbench.reports.figures.style import (
    LEGEND_LINE,
    TITLE,
    curve,
    legible,
    log,
    look,
    solver_keys,
    with_legend,
)

CROWDED = 1000  #: number of markers above which markers are smaller and paler
_COLUMNS = 4  #: number of columns of the legend
_LEAST = 1e-17  #: smaller residuals, including zero, are drawn at this value
_LEAST_RATIO = 1e-10  #: smaller ratios of residual to tolerance are drawn at this value
_BARS = {"cap": 1.5, "width": 0.6, "opacity": 0.55}

Sweep = Mapping[str, Sequence[Outcome]]  #: answers by solver, in order of tolerance


def accuracy_figure(evidence: Evidence) -> Figure | None:
    """Plot residuals against time; markers of verified answers are filled."""
    shown = [o for o in evidence.flat if o.worst is not None and o.seconds("total")]
    if not shown:
        return None
    points: dict[tuple[str, bool], list[tuple[Any, float, Outcome]]] = {}
    for o in shown:
        time, excess = o.seconds("total"), (o.worst or 0.0) / o.first.judged_at
        point = time and time.value, max(excess, _LEAST_RATIO), o
        points.setdefault((o.solver, o.verified), []).append(point)
    looks = {s: replace(look(i), dash=None) for i, s in enumerate(evidence.solvers)}
    size, opacity = (2.6, 0.5) if len(shown) > CROWDED else (4.5, 0.85)
    marks = list[Series]()
    for solver, style in looks.items():
        for verified, fill in ((True, ""), (False, "none")):
            drawn = replace(style, size=size, opacity=opacity, fill=fill)
            marks += curve(points.get((solver, verified), ()), drawn, solver)
    panel = Panel(
        x=log("median total time in s"),
        y=log("worst residual / tolerance"),
        marks=tuple(marks),
        rules=(Rule(axis="y", at=evidence.factor, look=Look(colour=INK, width=0.8)),),
        texts=(
            Text(
                text="verified below",
                place=(0.995, evidence.factor),
                inside=(True, False),
                offset=(0, -3),
                align=("right", "top"),
            ),
        ),
    )
    names = dict.fromkeys(o.solver for o in shown)
    keys = tuple(Key(label=legible(s), look=looks[s], solver=s) for s in names)
    return Figure(
        rows=(Row(panels=(panel,)),),
        height=TITLE + max(3.2, 0.5 + LEGEND_LINE * len(names)),
        title=legible(shared(shown), 96),
        legend=Legend(keys=keys, place="right"),
    )


def sweep_figure(swept: Sequence[tuple[str, Sweep]], solvers: Sequence[str]) -> Figure:
    """Plot the largest residual against time, with a panel for each (case, sweep).

    solvers : all solvers of the report, whose order determines colours and markers
    """
    panels = []
    for case, row in swept:
        marks = list[Series]()
        for solver, outcomes in row.items():
            marks += _residuals(outcomes, look(solvers.index(solver)))
        allowed = next(iter(row.values()))[0].allowed
        rules = [Rule(axis="y", at=allowed, look=Look(colour=INK, width=0.8))]
        panels.append(_panel(case, "worst residual", marks, rules))
    return _figure(panels, swept, solvers)


def _panel(
    case: str, error: str, marks: Sequence[Series], rules: Sequence[Rule] = ()
) -> Panel:
    return Panel(
        x=log("median total time in s"),
        y=log(error),
        title=legible(case),
        marks=tuple(marks),
        rules=tuple(rules),
    )


def _residuals(outcomes: Sequence[Outcome], style: Look) -> list[Series]:
    """Plot residual against time of a solver; hollow markers: unverified answers."""
    points = [
        (t.value, max(o.worst, _LEAST), o)
        for o in outcomes
        if o.worst is not None and (t := o.seconds("total")) is not None
    ]
    verified = [point for point in points if point[-1].verified]
    solver = outcomes[0].solver
    return [
        *curve(points, replace(style, fill="none"), solver),
        *curve(verified, replace(style, dash=None), solver),
    ]


def certified_figure(
    swept: Sequence[tuple[str, Sweep]], solvers: Sequence[str]
) -> Figure:
    """Plot the certified error against time, with a panel for each (case, sweep).

    solvers : all solvers of the report, whose order determines colours and markers
    """
    panels = []
    for case, row in swept:
        marks = list[Series]()
        for solver in (s for s in solvers if s in row):
            marks += _certified(row[solver], look(solvers.index(solver)))
        panels.append(_panel(case, "certified relative error", marks))
    return _figure(panels, swept, solvers)


def _certified(outcomes: Sequence[Outcome], style: Look) -> list[Series]:
    """Connect the points that `counts` accepts by a line; draw the others hollow."""
    points = [
        (o.seconds("total"), max(e, SMALLEST), o)
        for o in outcomes
        if (e := o.largest("energy_bound")) is not None and isfinite(e)
    ]
    apart, bars = replace(style, fill="none", dash=None), _BARS
    return [
        *curve((p for p in points if counts(p[-1])), style, outcomes[0].solver, bars),
        *curve(
            (p for p in points if not counts(p[-1])), apart, outcomes[0].solver, bars
        ),
    ]


def _figure(
    panels: Sequence[Panel],
    swept: Sequence[tuple[str, Sweep]],
    solvers: Sequence[str],
) -> Figure:
    """Arrange panels in two columns above a legend of solvers."""
    present = [s for s in solvers if any(s in row for _, row in swept)]
    rows = in_rows(panels, min(len(panels), 2))
    return with_legend(
        rows, solver_keys(present, solvers), _COLUMNS, 0.3 + 2.6 * len(rows)
    )
