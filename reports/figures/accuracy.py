"""The accuracy that was reached against the time that it took."""

from __future__ import annotations

from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from reports.data.evidence import Evidence, Outcome
from reports.figures.provenance import behind
from reports.figures.style import INK, LEGEND_LINE, STYLE, legible, log_log, look

CROWDED = 1000  #: marks; more of them are drawn smaller and let others through


def accuracy_figure(evidence: Evidence) -> Figure | None:
    """Draw the accuracy reached against the time spent, verified answers filled."""
    shown = [o for o in evidence.flat if o.worst is not None and o.seconds("total")]
    if not shown:
        return None
    with rc_context(STYLE):
        names = list(dict.fromkeys(o.solver for o in shown))
        figure = Figure(figsize=(6.9, max(3.2, 0.5 + LEGEND_LINE * len(names))))
        axes = figure.subplots()
        crowd = {"markersize": 2.6, "alpha": 0.5} if len(shown) > CROWDED else {}
        for index, solver in enumerate(evidence.solvers):
            mine = [o for o in shown if o.solver == solver]
            style = look(index, line=False) | crowd
            _scatter(axes, [o for o in mine if o.verified], style=style)
            refuted = {**style, "markerfacecolor": "none"}
            _scatter(axes, [o for o in mine if not o.verified], style=refuted)
        axes.axhline(evidence.factor, color=INK, linewidth=0.8)
        axes.annotate(
            "verified below",
            (0.995, evidence.factor),
            xycoords=("axes fraction", "data"),
            xytext=(0, -3),
            textcoords="offset points",
            va="top",
            ha="right",
            fontsize=8.5,
        )
        log_log(axes, "median total time in s", "worst residual / tolerance")
        keys = [
            Line2D([], [], **look(evidence.solvers.index(s), line=False)) for s in names
        ]
        figure.legend(
            keys,
            [legible(s) for s in names],
            loc="outside right upper",
        )
    return figure


def _scatter(axes: Axes, outcomes: list[Outcome], *, style: dict[str, Any]) -> None:
    """Plot (median time, worst residual / tolerance), zero raised to 1e-10."""
    points = [
        (t.value, max((o.worst or 0.0) / o.tol, 1e-10), o.records)
        for o in outcomes
        if (t := o.seconds("total")) is not None
    ]
    if points:
        x, y, runs = zip(*points, strict=True)
        (line,) = axes.plot(x, y, **({"alpha": 0.85} | style))
        behind(line, runs)
