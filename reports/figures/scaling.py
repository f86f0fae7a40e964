"""Total time and iterations against size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import sqrt

from mortarbench.reports.data.size_series import SizeSeries
from mortarbench.reports.document.figure import (
    Axis,
    Figure,
    Key,
    Limits,
    Look,
    Panel,
    Row,
    Series,
    Text,
    limits,
)
from mortarbench.reports.document.formatting import exponent
from mortarbench.reports.figures.style import (
    GUIDE,
    LEGEND_LINE,
    TITLE,
    below,
    curve,
    legible,
    log,
    look,
    with_legend,
)

MOST_SERIES = 6  #: that are drawn; all are tabulated
_SIZE = "degrees of freedom $n$"
SLOPES = ((1.0, "$n$"), (1.5, "$n^{3/2}$"))  #: of guides, the steepest last
_FOOT = 0.04  #: part of the axis below the guides, and above them at least


def scaling_figure(series: SizeSeries, solvers: Sequence[str]) -> Figure:
    """Draw total time and iterations against n on logarithmic axes."""
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
    lines = -(-len(series.solvers) // 2)  # of the legend
    return Figure(
        rows=(Row(panels=(left, right)),),
        height=2.4 + TITLE + LEGEND_LINE * max(lines, 3),
        legend=below(keys, 2),
        title=legible(series.title, 96),
    )


def iterations_figure(found: Sequence[SizeSeries], solver: str) -> Figure | None:
    """Draw the iterations of one solver in every series; None without any."""
    curves = list[Series]()
    keys = list[Key]()
    for series in found[:MOST_SERIES]:
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
    """Draw the iterations over the size, the middle of both ends."""
    answers = ((n, o.iterations, o) for n, o in series.curve(solver))
    return curve([(n, i and sum(i) / 2, o) for n, i, o in answers], style, solver)


def with_slopes(panel: Panel) -> Panel:
    """Add guides of slopes 1 and 3/2 through the lower right.

    Where y differs less than the guides rise, its axis goes on at both ends.
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
        x=replace(panel.x, low=x0, high=x1), y=replace(panel.y, low=y0, high=y1),
        marks=(*guides, *panel.marks), texts=(*panel.texts, *texts),
    )  # fmt: skip


def along(ends: Limits, part: float) -> float:
    """Find the value at a part of a logarithmic axis."""
    low, high = ends
    return float(low * (high / low) ** part)
