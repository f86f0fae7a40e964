"""The accuracy that was reached against the time that it took."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from mortarbench.reports.data.evidence import Evidence, Outcome, shared
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
)
from mortarbench.reports.figures.style import (
    LEGEND_LINE,
    TITLE,
    legible,
    log,
    look,
    run_ids,
)

CROWDED = 1000  #: marks; more of them are drawn smaller and let others through
_LEAST = 1e-10  #: worst residuals over the tolerance below, zero among them


def accuracy_figure(evidence: Evidence) -> Figure | None:
    """Draw the accuracy reached against the time spent, verified answers filled."""
    shown = [o for o in evidence.flat if o.worst is not None and o.seconds("total")]
    if not shown:
        return None
    names = list(dict.fromkeys(o.solver for o in shown))
    looks = {s: replace(look(i), dash=None) for i, s in enumerate(evidence.solvers)}
    crowded = len(shown) > CROWDED
    marks = []
    for solver in (s for s in evidence.solvers if s in names):
        mine = [o for o in shown if o.solver == solver]
        size, opacity = (2.6, 0.5) if crowded else (4.5, 0.85)
        filled = replace(looks[solver], size=size, opacity=opacity)
        for verified, style in ((True, filled), (False, replace(filled, fill="none"))):
            if chosen := [o for o in mine if o.verified is verified]:
                marks.append(_points(chosen, style))
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
    keys = tuple(Key(label=legible(s), look=looks[s], solver=s) for s in names)
    return Figure(
        rows=(Row(panels=(panel,)),),
        height=TITLE + max(3.2, 0.5 + LEGEND_LINE * len(names)),
        title=legible(shared(shown), 96),
        legend=Legend(keys=keys, place="right"),
    )


def _points(outcomes: Sequence[Outcome], style: Look) -> Series:
    """Median time, and worst residual over tolerance, of a solver's answers."""
    points = [
        (t.value, max((o.worst or 0.0) / o.first.asked_tol, _LEAST), run_ids(o.records))
        for o in outcomes
        if (t := o.seconds("total")) is not None
    ]
    x, y, runs = zip(*points, strict=True)
    return Series(x=x, y=y, runs=runs, look=style, solver=outcomes[0].solver)
