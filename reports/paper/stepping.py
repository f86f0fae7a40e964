"""How accurate the paper's load steps are: errors against their number, and orders."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from harness.files.experiment import Row
from reports.document.formatting import exponent, significant
from reports.document.layout import Cell, Table
from reports.figures.style import INK, STYLE, log_log, look
from reports.statistics.intervals import PowerLaw, power_law

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
    with rc_context(STYLE):
        figure = Figure(figsize=(6.9, 3.1))
        panels = figure.subplots(1, 2)
        for letter, axes, quantity in zip("ab", panels, QUANTITIES, strict=True):
            for i, relin in enumerate(linearisations(rows)):
                points = [p for p in errors(rows, relin, quantity) if p[1] > 0]
                axes.plot(*zip(*points, strict=True), label=f"{relin}", **look(i))
            log_log(axes, "load steps", "relative error")
            _first_order(axes)
            axes.set_title(f"({letter}) {quantity}", loc="left")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside lower center", ncols=len(labels),
            title="linearisations per step",
        )  # fmt: skip
    return figure


def _first_order(axes: Axes) -> None:
    """Draw a guide of slope −1 above the curves."""
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    start, stop = x0 * (x1 / x0) ** 0.55, x0 * (x1 / x0) ** 0.85
    top = y0 * (y1 / y0) ** 0.93
    axes.plot([start, stop], [top, top * start / stop], color=INK, linewidth=0.6)
    axes.annotate(
        "first order", (np.sqrt(start * stop), top * np.sqrt(start / stop)),
        xytext=(4, 3), textcoords="offset points", fontsize=8.5,
    )  # fmt: skip
    axes.set(xlim=(x0, x1), ylim=(y0, y1))


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
