"""Time, iterations, operation counts and condition numbers against size and H/h."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import sqrt
from typing import Any

import numpy as np

from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.data.size_series import SizeSeries, Sweep
from mortarbench.reports.document.figure import (
    Axis,
    Figure,
    Key,
    Limits,
    Look,
    Mark,
    Panel,
    Row,
    Series,
    Text,
    in_rows,
    limits,
    numbers,
)
from mortarbench.reports.document.formatting import exponent
from mortarbench.reports.figures.style import (
    COLOURS,
    DASHED,
    GUIDE,
    LEGEND_LINE,
    MARKERS,
    TITLE,
    below,
    curve,
    legible,
    log,
    look,
    with_legend,
)
from mortarbench.reports.statistics.intervals import PowerLaw

MOST_SERIES = 6  #: largest number of plotted series; all are tabulated
_SIZE = "degrees of freedom $n$"
SLOPES = ((1.0, "$n$"), (1.5, "$n^{3/2}$"))  #: slopes of guide lines, the steepest last
#: panels of counts, with the names that SMALBE uses; other counts are only tabulated
PANELS = (
    ("products", ("P_products", "preconditioner_applies")),
    ("steps", ("cg", "expansion", "proportioning")),
)
KAPPA = "kappa"  #: prefix of the names of condition numbers
_FITTED = 24  #: number of points of a fitted curve
_FOOT = 0.04  #: minimum fraction of the axis below and above the guide lines


def scaling_figure(series: SizeSeries, solvers: Sequence[str]) -> Figure:
    """Plot total time and iterations against n on logarithmic axes."""
    times, counts, keys = list[Series](), list[Series](), []
    for solver in series.solvers:
        style, answers = look(solvers.index(solver)), series.curve(solver)
        if timed := curve(
            [(n, o.seconds("total"), o) for n, o in answers], style, solver
        ):
            law = series.time_law(solver)
            label = legible(solver) + (f",  p = {exponent(law)}" if law else "")
            keys.append(Key(label=label, look=style, solver=solver))
            times += timed
        counts += _counts(series, solver, style)
    left = with_slopes(
        Panel(x=log(_SIZE), y=log("total time in s"), marks=tuple(times))
    )
    right = Panel(x=log(_SIZE), y=log("iterations"), marks=tuple(counts))
    lines = -(-len(series.solvers) // 2)  # lines of the legend
    return Figure(
        rows=(Row(panels=(left, right)),),
        height=2.4 + TITLE + LEGEND_LINE * max(lines, 3),
        legend=below(keys, 2),
        title=legible(series.title, 96),
    )


def iterations_figure(plotted: Sequence[SizeSeries], solver: str) -> Figure | None:
    """Plot the iterations of one solver in the first `MOST_SERIES` series, if known."""
    curves = list[Series]()
    keys = list[Key]()
    for series in plotted[:MOST_SERIES]:
        style = look(len(keys))
        if counted := _counts(series, solver, style):
            keys.append(Key(label=legible(series.title, 64), look=style))
            curves += counted
    if not curves:
        return None
    most = max(max(drawn.y) for drawn in curves)
    panel = Panel(
        x=log(_SIZE),
        y=Axis(label="iterations", low=0.0, high=1.15 * most, most=6, integers=True),
        marks=tuple(curves),
        title=legible(f"{solver}, verified answers", 64),
    )
    return with_legend((Row(panels=(panel,)),), keys, 1, 2.6)


def _counts(series: SizeSeries, solver: str, style: Look) -> list[Series]:
    """Return iterations against size; if repeats differ, midpoints of their range."""
    answers = ((n, o.iterations, o) for n, o in series.curve(solver))
    return curve([(n, i and sum(i) / 2, o) for n, i, o in answers], style, solver)


def with_slopes(panel: Panel) -> Panel:
    """Add guide lines of slopes 1 and 3/2 at the lower right.

    The y axis is extended at both ends if it is shorter than the rise of the guides.
    """
    (x0, x1), (y0, y1) = limits([panel], "x"), limits([panel], "y")
    start, stop = along((x0, x1), 0.62), along((x0, x1), 0.9)
    rise = (stop / start) ** SLOPES[-1][0]
    missing = max(rise ** (1 / (1 - 2 * _FOOT)) / (y1 / y0), 1.0)
    y0, y1 = y0 / sqrt(missing), y1 * sqrt(missing)
    base = along((y0, y1), _FOOT)
    guides, texts = [], []
    for slope, name in SLOPES:
        end = base * (stop / start) ** slope
        guides.append(Series(x=(start, stop), y=(base, end), look=GUIDE))
        texts.append(Text(text=name, place=(stop, end), offset=(2, 0)))
    return replace(
        panel,
        x=replace(panel.x, low=x0, high=x1),
        y=replace(panel.y, low=y0, high=y1),
        marks=(*guides, *panel.marks),
        texts=(*panel.texts, *texts),
    )


def along(ends: Limits, part: float) -> float:
    """Return the value at a fraction of a logarithmic axis."""
    low, high = ends
    return float(low * (high / low) ** part)


def steps_figure(series: SizeSeries, solver: str) -> Figure | None:
    """Plot counts and condition numbers of one solver against dofs, with fits c·nᵖ.

    Condition numbers are not fitted. Return None if there is nothing to plot.
    """
    points = [(float(n), o) for n, o in series.curve(solver)]
    laws = {name: series.count_law(solver, name) for name in series.counts(solver)}
    title = f"{solver}, {series.title}"
    return _counted(points, log("degrees of freedom $n$"), laws, solver, title)


def subdomain_figure(sweep: Sweep) -> Figure | None:
    """Plot counts and condition numbers against H/h; None if there are neither."""
    points = [(float(value), o) for value, o in sweep.answers]
    shown = tuple((x, f"{x:g}") for x, _ in points)
    low, high = points[0][0] / 1.15, points[-1][0] * 1.15
    axis = Axis(label="cells $H/h$", log=True, low=low, high=high, ticks=shown)
    return _counted(points, axis, {}, sweep.solver, f"{sweep.solver}, {sweep.title}")


def _counted(
    points: Sequence[tuple[float, Outcome]],
    x: Axis,
    laws: dict[str, PowerLaw | None],
    solver: str,
    title: str,
) -> Figure | None:
    groups: dict[str, dict[str, tuple[Sequence[Any], PowerLaw | None]]] = {
        panel: {
            legible(name.replace("_", " ")): (counted, laws.get(name))
            for name in names
            if None not in (counted := [o.counted(name) for _, o in points])
        }
        for panel, names in PANELS
    }
    groups["condition number"] = {
        " ".join([r"$\kappa$", *legible(name).split()[1:]]): (values, None)
        for name, values in condition_numbers(points).items()
    }
    panels, keys = list[Panel](), list[Key]()
    for name, curves in groups.items():
        if not curves:
            continue
        marks = list[Mark]()
        for label, (values, law) in curves.items():
            i = len(keys)
            colour = COLOURS[i % len(COLOURS)]
            style = Look(colour=colour, marker=MARKERS[i % len(MARKERS)])
            if law is not None:
                n = np.geomspace(points[0][0], points[-1][0], _FITTED)
                fit = Look(colour=colour, dash=DASHED, width=0.9)
                marks.append(Series(x=numbers(n), y=numbers(law.at(n)), look=fit))
                style = replace(style, dash=None)
                label += f",  p = {exponent(law)}"
            answers = ((x, v, o) for (x, o), v in zip(points, values, strict=True))
            marks += curve(answers, style, solver)
            keys.append(Key(label=label, look=style))
        most = max(float(v) for values, _ in curves.values() for v in values)
        y = Axis(low=0.0, high=1.12 * most or 1.0, integers=True, most=6)
        panels.append(Panel(x=x, y=y, title=name, marks=tuple(marks)))
    if not panels:
        return None
    rows = in_rows(panels, 2)
    if len(panels) == 3:  # κ in the second row, over both columns
        rows = (rows[0], Row(panels=(replace(panels[2], span=2),)))
    return with_legend(rows, keys, 2, 0.2 + 2.3 * len(rows), title)


def condition_numbers(
    points: Sequence[tuple[float, Outcome]],
) -> dict[str, tuple[float, ...]]:
    """Return condition numbers present in all answers, without their error bounds."""
    names = [
        name
        for name in (points[0][1].quantities if points else ())
        if (name == KAPPA or name.startswith(f"{KAPPA}_"))
        and not name.endswith("_error")
    ]
    kappas: dict[str, tuple[float, ...]] = {}
    for name in names:
        values = [o.quantities.get(name) for _, o in points]
        numeric = tuple(float(v) for v in values if isinstance(v, int | float))
        if len(numeric) == len(points):
            kappas[" ".join(["κ", *name.removeprefix(KAPPA).split("_")[1:]])] = numeric
    return kappas
