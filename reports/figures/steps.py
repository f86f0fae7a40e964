"""What solvers count, each kind apart, against size and against H/h; and κ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
    LEGEND_LINE,
    MARKERS,
    TITLE,
    below,
    legible,
    log,
    run_ids,
)
from mortarbench.reports.statistics.intervals import PowerLaw

#: panels of counts, whose names are those of SMALBE; others are in the tables
PANELS = (
    ("products", ("P_products", "preconditioner_applies")),
    ("steps", ("cg", "expansion", "proportioning")),
)
KAPPA = "kappa"  #: condition numbers among the quantities begin so
_FITTED = 24  #: points of a curve of a fit


@dataclass(frozen=True, kw_only=True)
class _Curve:
    """One count, or κ, against size."""

    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    answers: tuple[Outcome, ...]
    law: PowerLaw | None = None


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
    panels: list[Panel] = []
    keys: list[Key] = []
    groups = [
        *((title, [*_counts(points, names, laws)]) for title, names in PANELS),
        ("condition number", _condition_curves(points)),
    ]
    for name, curves in groups:
        if not curves:
            continue
        marks: list[Mark] = []
        for curve in curves:
            i = len(keys)
            colour = COLOURS[i % len(COLOURS)]
            style = Look(colour=colour, marker=MARKERS[i % len(MARKERS)], dash=None)
            joined = Look(colour=colour, marker=MARKERS[i % len(MARKERS)])
            label = curve.label
            if curve.law is not None:
                marks.append(_fit(curve, colour))
                label += f",  p = {exponent(curve.law)}"
            chosen = joined if curve.law is None else style
            marks.append(
                Series(
                    x=curve.x, y=curve.y, look=chosen, solver=solver,
                    runs=tuple(run_ids(o.records) for o in curve.answers),
                )
            )  # fmt: skip
            keys.append(Key(label=label, look=chosen))
        most = max(max(curve.y) for curve in curves)
        panels.append(
            Panel(
                x=x, y=Axis(low=0.0, high=1.12 * most or 1.0, integers=True, most=6),
                title=name, marks=tuple(marks),
            )
        )  # fmt: skip
    if not panels:
        return None
    rows = in_rows(panels, 2)
    if len(panels) == 3:  # κ below, as wide as both
        rows = (rows[0], Row(panels=(replace(panels[2], span=2),)))
    return Figure(
        rows=rows,
        height=0.2 + TITLE + 2.3 * len(rows) + LEGEND_LINE * -(-len(keys) // 2),
        legend=below(keys, 2),
        title=legible(title, 96),
    )


def _counts(
    points: Sequence[tuple[float, Outcome]],
    names: Sequence[str],
    laws: dict[str, PowerLaw | None],
) -> list[_Curve]:
    found = []
    for name in names:
        counted = [(x, c, o) for x, o in points if (c := o.counted(name)) is not None]
        if len(counted) == len(points):
            x, y, answers = zip(*counted, strict=True)
            found.append(
                _Curve(
                    label=legible(name.replace("_", " ")),
                    x=x,
                    y=y,
                    answers=answers,
                    law=laws.get(name),
                )
            )
    return found


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


def _condition_curves(points: Sequence[tuple[float, Outcome]]) -> list[_Curve]:
    return [
        _Curve(
            label=" ".join([r"$\kappa$", *legible(name).split()[1:]]),
            x=tuple(x for x, _ in points),
            y=values,
            answers=tuple(o for _, o in points),
        )
        for name, values in condition_numbers(points).items()
    ]


def _fit(curve: _Curve, colour: str) -> Series:
    assert curve.law is not None
    n = np.geomspace(min(curve.x), max(curve.x), _FITTED)
    return Series(
        x=numbers(n), y=numbers(curve.law.at(n)),
        look=Look(colour=colour, dash=DASHED, width=0.9),
    )  # fmt: skip
