"""The accuracy that was reached against the time that it took."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

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
    curve,
    legible,
    log,
    look,
)

CROWDED = 1000  #: marks; more of them are drawn smaller and let others through
_LEAST = 1e-10  #: worst residuals over the tolerance below, zero among them


def accuracy_figure(evidence: Evidence) -> Figure | None:
    """Draw the accuracy reached against the time spent, verified answers filled."""
    shown = [o for o in evidence.flat if o.worst is not None and o.seconds("total")]
    if not shown:
        return None
    points: dict[tuple[str, bool], list[tuple[Any, float, Outcome]]] = {}
    for o in shown:
        time, excess = o.seconds("total"), (o.worst or 0.0) / o.first.asked_tol
        point = time and time.value, max(excess, _LEAST), o
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
