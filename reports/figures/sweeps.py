"""Errors that were reached against the time that it took, and sweeps of tolerances."""

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
    DASHED,
    DOTTED,
    LEGEND_LINE,
    TITLE,
    curve,
    legible,
    log,
    look,
    solver_keys,
    with_legend,
)

SHARE = 0.1  #: of the discretisation error that a solver may add
CROWDED = 1000  #: marks; more of them are drawn smaller and let others through
_COLUMNS = 4  #: of the legend
_LEAST = 1e-17  #: residuals below, zero among them, are drawn there
_LEAST_RATIO = 1e-10  #: the same of residuals over the tolerance
_MESH = Look(colour=INK, width=0.8, dash=DASHED)
_TENTH = Look(colour=INK, width=0.8, dash=DOTTED)
_BARS = {"cap": 1.5, "width": 0.6, "opacity": 0.55}

Sweep = Mapping[str, Sequence[Outcome]]  #: solver → its answers, by tolerance


def accuracy_figure(evidence: Evidence) -> Figure | None:
    """Draw the accuracy reached against the time spent, verified answers filled."""
    shown = [o for o in evidence.flat if o.worst is not None and o.seconds("total")]
    if not shown:
        return None
    points: dict[tuple[str, bool], list[tuple[Any, float, Outcome]]] = {}
    for o in shown:
        time, excess = o.seconds("total"), (o.worst or 0.0) / o.first.asked_tol
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
                text="verified below", place=(0.995, evidence.factor),
                inside=(True, False), offset=(0, -3), align=("right", "top"),
            ),
        ),
    )  # fmt: skip
    names = dict.fromkeys(o.solver for o in shown)
    keys = tuple(Key(label=legible(s), look=looks[s], solver=s) for s in names)
    return Figure(
        rows=(Row(panels=(panel,)),),
        height=TITLE + max(3.2, 0.5 + LEGEND_LINE * len(names)),
        title=legible(shared(shown), 96),
        legend=Legend(keys=keys, place="right"),
    )


def sweep_figure(swept: Sequence[tuple[str, Sweep]], solvers: Sequence[str]) -> Figure:
    """Draw the largest residual against the time, a panel for each (case, sweep).

    solvers : of the whole report, which their looks go by
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
    case: str, error: str, marks: Sequence[Series], rules: Sequence[Rule]
) -> Panel:
    return Panel(
        x=log("median total time in s"),
        y=log(error),
        title=legible(case),
        marks=tuple(marks),
        rules=tuple(rules),
    )


def _residuals(outcomes: Sequence[Outcome], style: Look) -> list[Series]:
    """Join the answers of one solver; hollow where they are not verified."""
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
    swept: Sequence[tuple[str, Sweep]],
    solvers: Sequence[str],
    meshes: Mapping[str, float],
) -> Figure:
    """Draw the certified error against the time, a panel for each (case, sweep).

    solvers : of the whole report, which their looks go by
    meshes : physical case → its discretisation error, where one is known
    """
    panels, lines = [], []
    for case, row in swept:
        marks, rules = list[Series](), list[Rule]()
        for solver in (s for s in solvers if s in row):
            marks += _certified(row[solver], look(solvers.index(solver)))
        error = meshes.get(next(iter(row.values()))[0].physical)
        if error is not None:
            lines = [("discretisation error", _MESH), ("a tenth of it", _TENTH)]
            rules = [Rule(axis="y", at=error, look=_MESH),
                     Rule(axis="y", at=SHARE * error, look=_TENTH)]  # fmt: skip
        panels.append(_panel(case, "certified relative error", marks, rules))
    return _figure(panels, swept, solvers, lines)


def _certified(outcomes: Sequence[Outcome], style: Look) -> list[Series]:
    """Join the points that count; mark the others hollow, on their own."""
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
    lines: Sequence[tuple[str, Look]] = (),
) -> Figure:
    """Put the panels side by side above a legend of solvers and further lines."""
    present = [s for s in solvers if any(s in row for _, row in swept)]
    keys = [*solver_keys(present, solvers), *(Key(label=s, look=l) for s, l in lines)]
    rows = in_rows(panels, min(len(panels), 2))
    return with_legend(rows, keys, _COLUMNS, 0.3 + 2.6 * len(rows))
