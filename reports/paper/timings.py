"""Figures 3 to 6: times against sizes, with the intervals of their medians."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from mortarbench.harness import Vector
from mortarbench.harness.files.experiment import Row
from mortarbench.reports.document import figure
from mortarbench.reports.document.figure import (
    INK,
    Area,
    Axis,
    Figure,
    Intervals,
    Key,
    Legend,
    Look,
    Panel,
    Series,
    Text,
    limits,
    numbers,
)
from mortarbench.reports.figures.style import COLOURS, below, log, look
from mortarbench.reports.paper import published
from mortarbench.reports.paper.samples import Fit, Point, curve, fit

DOFS = "degrees of freedom $n$"
METHODS = {  #: of the tables → as the figures and tables of the report call them
    "triplets": "triplets, vectorised (the paper's way)",
    "compiled": "compiled, with its pattern",
    "compiled-reused": "compiled, pattern reused",
    "geometric": "Cholesky, fixing nodes by geometry",
    "spectral": "Cholesky, fixing nodes by spectra (the paper's way)",
    "pinv": "dense pinv",
    "per-row": "one solve per row (the paper's way)",
    "condensed": "condensed",
}
_PUBLISHED = Look(colour=INK, marker="*", size=10, edge=0.9, dash=None, fill="white")
_FITTED = Look(colour=COLOURS[2], dash=(1, 1.5))


def _times(points: Sequence[Point], style: Look) -> Series:
    """Make medians and their intervals."""
    times = [p.time for p in points]
    low, high = tuple(t.low for t in times), tuple(t.high for t in times)
    return Series(
        x=tuple(p.x for p in points), y=tuple(t.value for t in times), look=style,
        intervals=Intervals(low=low, high=high),
    )  # fmt: skip


def _star(x: float, y: float, style: Look = _PUBLISHED) -> Series:
    """Make the mark of a published number."""
    return Series(x=(float(x),), y=(float(y),), look=style)


def _row(panels: Sequence[Panel]) -> figure.Row:
    return figure.Row(panels=tuple(panels))


def _titled(panels: Sequence[Panel], titles: Sequence[str]) -> tuple[Panel, ...]:
    return tuple(
        replace(panel, title=f"({letter}) {title}")
        for letter, panel, title in zip("abcdef", panels, titles, strict=False)
    )


def assembly_figure(rows: Sequence[Row]) -> Figure:
    """Draw Figure 3: linear and logarithmic."""
    methods = ("triplets", "compiled", "compiled-reused")
    curves = [
        _times(curve(rows, "n", method=m), look(i)) for i, m in enumerate(methods)
    ]
    marks = (*curves, _star(published.DOFS, published.SECONDS["assembly"]))
    keys = [Key(label=METHODS[m], look=look(i)) for i, m in enumerate(methods)]
    words = f"published, both bodies ({published.MACHINE})"
    time = "assembly time in s"
    left = Panel(
        x=Axis(label=DOFS, low=0, most=4), y=Axis(label=time, low=0), marks=marks,
        grid="none",
    )  # fmt: skip
    right = Panel(x=log(DOFS), y=log(time), marks=marks)
    return Figure(
        rows=(_row(_titled((left, right), ("linear scale", "logarithmic scale"))),),
        height=3.4,
        legend=below((*keys, Key(label=words, look=_PUBLISHED)), 2),
    )


def contact_figure(rows: Sequence[Row]) -> Figure:
    """Draw Figure 4: node-to-segment and mortar, a line for each number of masters."""
    masters = sorted({row["master"] for row in rows})
    place = published.SEGMENTS["slave"], published.SECONDS["contact"] / published.STEPS
    name = f"published\n({published.SEGMENTS['master']} master segments)"
    panels = []
    for method in ("nts", "mortar"):
        first = method == "nts"
        curves = [
            _times(curve(rows, "slave", method=method, master=master), look(i))
            for i, master in enumerate(masters)
        ]
        panels.append(
            Panel(
                x=log("slave segments"),
                y=Axis(
                    label="time of one linearisation in s" * first, log=True, high=0.7,
                    shared="time", numbered=first,
                ),
                marks=(*curves, _star(*place)) if first else tuple(curves),
                texts=(Text(text=name, place=place, offset=(9, 0)),) if first else (),
            )
        )  # fmt: skip
    titles = ("node-to-segment, as in the paper", "mortar, dual basis")
    keys = [Key(label=f"{master}", look=look(i)) for i, master in enumerate(masters)]
    return Figure(
        rows=(_row(_titled(panels, titles)),),
        height=3.6,
        legend=below(keys, len(masters), "master segments"),
    )


def inverse_figure(rows: Sequence[Row]) -> Figure:
    """Draw Figure 5: building K⁺ and multiplying with it."""
    looks = {"pinv": look(2), "geometric": look(0), "spectral": look(1)}
    until = float(max(r["n"] for r in rows))
    panels = []
    for part in ("build", "multiply"):
        curves = [
            _times(curve(rows, "n", method=method, part=part), style)
            for method, style in looks.items()
        ]
        band, law = _extrapolation(pinv_fit(rows, part), until)
        panels.append(
            Panel(x=log(DOFS), y=log("time in s"), marks=(*curves, band, law))
        )
    words = "dense pinv, not measured: fitted $c\\,n^3$ (a), $c\\,n^2$ (b)"
    keys = [Key(label=METHODS[m], look=style) for m, style in looks.items()]
    titles = ("building", "multiplication with a random vector")
    return Figure(
        rows=(_row(_titled(panels, titles)),),
        height=3.6,
        legend=below((*keys, Key(label=words, look=_FITTED)), 2),
    )


def pinv_fit(rows: Sequence[Row], part: str) -> Fit:
    """Fit c·n³ to building the dense pseudoinverse, c·n² to multiplying with it."""
    points = curve(rows, "n", method="pinv", part=part)
    return fit(points, 3 if part == "build" else 2)


def _extrapolation(law: Fit, until: float) -> tuple[Area, Series]:
    """Continue the fit where nothing was measured, with its band."""
    x = np.geomspace(law.until, until, 40)
    at, low, middle, high = (
        numbers(v) for v in (x, *(c * x**law.power for c in (law.low, law.c, law.high)))
    )
    band = Area(x=at, low=low, high=high, colour=COLOURS[2], opacity=0.2)
    return band, Series(x=at, y=middle, look=_FITTED)


def scaling_figure(rows: Sequence[Row]) -> Figure:
    """Draw Figure 6: sizes, constraints, dualisation and QPs, the whole."""
    panels = _titled(
        (*_sizes(rows), _dual(rows), _total(rows)),
        ("size of the problems", "constraints", "dualisation and QPs, all steps",
         "the whole analysis"),
    )  # fmt: skip
    return Figure(rows=figure.in_rows(panels, 2), height=6.3)


def _sizes(rows: Sequence[Row]) -> tuple[Panel, Panel]:
    points = sorted({(r["Nr"], r["n"], r["m_E"], r["m_I"]) for r in rows})
    Nr, n, m_E, m_I = np.array(points, dtype=float).T

    def panel(y: Axis, curves: Mapping[str, Vector]) -> Panel:
        looks = {name: look(i) for i, name in enumerate(curves)}
        marks = tuple(
            Series(x=numbers(Nr), y=numbers(values), look=looks[name])
            for name, values in curves.items()
        )
        keys = tuple(Key(label=name, look=style) for name, style in looks.items())
        legend = Legend(keys=keys, place="upper left")
        return Panel(x=Axis(label="$N_r$"), y=y, marks=marks, legend=legend)

    most = float(max(m_E.max(), m_I.max()))
    return (
        panel(
            Axis(label="unknowns", log=True, low=100, high=1e5),
            {"primal, $n$": n, "dual, $m = m_E + m_I$": m_E + m_I},
        ),
        panel(
            Axis(label="rows", low=0, high=1.35 * most),
            {"Dirichlet equalities $m_E$": m_E, "contact inequalities $m_I$": m_I},
        ),
    )


def _dual(rows: Sequence[Row]) -> Panel:
    rows = [{**row, "m": int(row["m_E"]) + int(row["m_I"])} for row in rows]
    marks, keys = [], []
    for i, (method, parts, label) in enumerate((
        ("per-row", ("dualisation",), "dualisation, one solve per row"),
        ("condensed", ("factor", "dualisation"), "the same, condensed, with factor"),
        ("per-row", ("qp",), "dual QPs, the textbook's SMALBE"),
        ("condensed", ("qp",), "dual QPs, our SMALBE"),
    )):  # fmt: skip
        points = curve(rows, "m", method=method, part=parts)
        marks.append(_times(points, look(i)))
        keys.append(Key(label=label, look=look(i)))
    stars = (("dualisation", "*", 9.0, "dualisation"), ("qp", "P", 7.0, "QPs"))
    for part, marker, size, name in stars:
        style = replace(_PUBLISHED, marker=marker, size=size)
        marks.append(_star(published.ROWS, published.SECONDS[part], style))
        keys.append(Key(label=f"published: {name}", look=style))
    return _with_head_room("size of the dual $m$", marks, keys, 3.8)


def _total(rows: Sequence[Row]) -> Panel:
    marks, keys = [], []
    for i, method in enumerate(("per-row", "condensed")):
        marks.append(_times(curve(rows, "n", method=method), look(i)))
        keys.append(Key(label=METHODS[method], look=look(i)))
    marks.append(_star(published.DOFS, published.TOTAL))
    keys.append(Key(label="published", look=_PUBLISHED))
    return _with_head_room("size of the primal $n$", marks, keys, 2.2)


def _with_head_room(
    size: str, marks: Sequence[Series], keys: Sequence[Key], decades: float
) -> Panel:
    """Make a panel with room for its legend above the curves."""
    legend = Legend(keys=tuple(keys), place="upper left", size=8)
    panel = Panel(
        x=Axis(label=size, most=4),
        y=log("time in s"),
        marks=tuple(marks),
        legend=legend,
    )
    low, high = limits([panel], "y")
    head = high * 10 ** (0.35 * decades)
    return replace(panel, y=replace(panel.y, low=low, high=head))
