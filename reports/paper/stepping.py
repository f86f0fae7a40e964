"""How accurate the paper's load steps are: errors against their number, and orders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import sqrt

import numpy as np

from mortarbench.harness.files.experiment import Row
from mortarbench.reports.document import figure
from mortarbench.reports.document.figure import Figure, Key, Panel, Series, Text, limits
from mortarbench.reports.document.formatting import exponent, significant
from mortarbench.reports.document.layout import Cell, Table
from mortarbench.reports.figures.scaling import along
from mortarbench.reports.figures.style import GUIDE, below, log, look
from mortarbench.reports.statistics.intervals import PowerLaw, power_law

QUANTITIES = {  #: of the figure → the columns that make a vector
    "tip displacement": ("tip_x", "tip_y"),
    "contact force": ("force_x", "force_y"),
}
SINCE = 5  #: steps: with fewer, the order is not yet seen
PAPER = 10  #: steps, one linearisation each


def errors(rows: Sequence[Row], relin: int, quantity: str) -> list[tuple[int, float]]:
    """List (steps, relative error); the last row of all is what they approach."""
    *ways, settled = rows
    columns = QUANTITIES[quantity]
    truth = np.array([float(settled[c]) for c in columns])
    found = []
    for row in ways:
        if row["relin"] == relin:
            off = np.array([float(row[c]) for c in columns]) - truth
            size = np.linalg.norm(off) / np.linalg.norm(truth)
            found.append((int(row["steps"]), float(size)))
    return sorted(found)


def order(rows: Sequence[Row], relin: int, quantity: str) -> PowerLaw | None:
    """Fit error ~ (1/steps)ᵖ from SINCE steps on; None with fewer than three."""
    kept = [(n, e) for n, e in errors(rows, relin, quantity) if n >= SINCE and e > 0]
    if len(kept) < 3:
        return None
    steps, sizes = zip(*kept, strict=True)
    return power_law([1 / n for n in steps], sizes)


def linearisations(rows: Sequence[Row]) -> list[int]:
    """Name the numbers of linearisations per step that were tried."""
    return sorted({int(r["relin"]) for r in rows[:-1]})


def stepping_figure(rows: Sequence[Row]) -> Figure:
    """Draw the errors of both quantities against the number of steps."""
    tried = linearisations(rows)
    panels = []
    for letter, quantity in zip("ab", QUANTITIES, strict=True):
        marks = []
        for i, relin in enumerate(tried):
            points = [p for p in errors(rows, relin, quantity) if p[1] > 0]
            steps, sizes = zip(*points, strict=True)
            marks.append(Series(x=steps, y=sizes, look=look(i)))
        panel = Panel(
            x=log("load steps"), y=log("relative error"), marks=tuple(marks),
            title=f"({letter}) {quantity}",
        )  # fmt: skip
        panels.append(_with_first_order(panel))
    keys = [Key(label=f"{relin}", look=look(i)) for i, relin in enumerate(tried)]
    return Figure(
        rows=(figure.Row(panels=tuple(panels)),),
        height=3.1,
        legend=below(keys, len(keys), "linearisations per step"),
    )


def _with_first_order(panel: Panel) -> Panel:
    """Add a guide of slope −1 above the curves."""
    (x0, x1), (y0, y1) = limits([panel], "x"), limits([panel], "y")
    start, stop = along((x0, x1), 0.55), along((x0, x1), 0.85)
    top = along((y0, y1), 0.93)
    guide = Series(x=(start, stop), y=(top, top * start / stop), look=GUIDE)
    name = Text(
        text="first order", place=(sqrt(start * stop), top * sqrt(start / stop)),
        offset=(4, 3), align=("left", "bottom"),
    )  # fmt: skip
    return replace(
        panel, x=replace(panel.x, low=x0, high=x1), y=replace(panel.y, low=y0, high=y1),
        marks=(*panel.marks, guide), texts=(name,),
    )  # fmt: skip


def orders(rows: Sequence[Row]) -> Table:
    """Tabulate fitted orders, and what is left at the paper's number of steps."""
    made = []
    for relin in linearisations(rows):
        cells = [Cell(text=str(relin), value=relin)]
        for quantity in QUANTITIES:
            law = order(rows, relin, quantity)
            left = dict(errors(rows, relin, quantity)).get(PAPER)
            cells += [
                Cell(text=exponent(law), value=law.exponent) if law else Cell(),
                Cell(text=significant(left, 2), value=left),
            ]
        made.append(tuple(cells))
    heads = [
        head for q in QUANTITIES
        for head in (f"{q}: order [95 %]", f"error at {PAPER} steps")
    ]  # fmt: skip
    return Table(
        caption=f"Order in 1/steps, fitted from {SINCE} steps on, and the relative "
        f"error that {PAPER} steps leave. The first line is the paper's scheme.",
        columns=("linearisations per step", *heads),
        rows=tuple(made),
        text_columns=0,
    )
