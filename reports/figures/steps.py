"""What solvers count, each kind apart, against size and against H/h; and κ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.data.size_series import SizeSeries, Sweep
from mortarbench.reports.document.figure import (
    Axis,
    Figure,
    Key,
    Look,
    Mark,
    Panel,
    Row,
    Series,
    in_rows,
    numbers,
)
from mortarbench.reports.document.formatting import exponent
from mortarbench.reports.figures.style import (
    COLOURS,
    DASHED,
    MARKERS,
    curve,
    legible,
    log,
    with_legend,
)
from mortarbench.reports.statistics.intervals import PowerLaw

#: panels of counts, whose names are those of SMALBE; others are in the tables
PANELS = (
    ("products", ("P_products", "preconditioner_applies")),
    ("steps", ("cg", "expansion", "proportioning")),
)
KAPPA = "kappa"  #: condition numbers among the quantities begin so
_FITTED = 24  #: points of a curve of a fit


def steps_figure(series: SizeSeries, solver: str) -> Figure | None:
    """Draw the counts of one solver against dofs with fits c·nᵖ; None without any."""
    points = [(float(n), o) for n, o in series.curve(solver)]
    laws = {name: series.count_law(solver, name) for name in series.counts(solver)}
    title = f"{solver}, {series.title}"
    return _figure(points, log("degrees of freedom $n$"), laws, solver, title)


def torn_figure(sweep: Sweep) -> Figure | None:
    """Draw the counts of one solver against H/h; None where none is known."""
    points = [(float(value), o) for value, o in sweep.answers]
    shown = tuple((x, f"{x:g}") for x, _ in points)
    low, high = points[0][0] / 1.15, points[-1][0] * 1.15
    axis = Axis(label="cells $H/h$", log=True, low=low, high=high, ticks=shown)
    return _figure(points, axis, {}, sweep.solver, f"{sweep.solver}, {sweep.title}")


def _figure(
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
    if len(panels) == 3:  # κ below, as wide as both
        rows = (rows[0], Row(panels=(replace(panels[2], span=2),)))
    return with_legend(rows, keys, 2, 0.2 + 2.3 * len(rows), title)


def condition_numbers(
    points: Sequence[tuple[float, Outcome]],
) -> dict[str, tuple[float, ...]]:
    """Return each κ that every answer has, without error bounds, by its name."""
    names = [
        name
        for name in (points[0][1].quantities if points else ())
        if (name == KAPPA or name.startswith(f"{KAPPA}_"))
        and not name.endswith("_error")
    ]
    found: dict[str, tuple[float, ...]] = {}
    for name in names:
        values = [o.quantities.get(name) for _, o in points]
        known = tuple(float(v) for v in values if isinstance(v, int | float))
        if len(known) == len(points):
            found[" ".join(["κ", *name.removeprefix(KAPPA).split("_")[1:]])] = known
    return found
