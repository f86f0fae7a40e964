"""Figures beyond the paper: pressures, both contact methods, load steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import sqrt

import numpy as np

from mortarbench.harness.results.experiment import Row
from mortarbench.reports.document import figure
from mortarbench.reports.document.figure import (
    Axis,
    ColourBar,
    Figure,
    Legend,
    Look,
    Panel,
    Series,
    Text,
    in_rows,
    limits,
)
from mortarbench.reports.document.formatting import exponent, significant
from mortarbench.reports.document.layout import Cell, Table
from mortarbench.reports.figures.scaling import along
from mortarbench.reports.figures.style import GUIDE, below, log, look
from mortarbench.reports.paper.bodies import ACTIVE
from mortarbench.reports.paper.timings import labelled, select, titled
from mortarbench.reports.statistics.intervals import PowerLaw, power_law

CONTACTS = {  #: name in tables → label in figures
    "nts": "node-to-segment (the paper's method)",
    "mortar": "mortar, dual basis",
    "mortar-standard": "mortar, standard basis",
}
EXACT = 1e-12  #: smaller relative errors are due to rounding and drawn at this value
QUANTITIES = {  #: name in the figure → columns of its components
    "tip displacement": ("tip_x", "tip_y"),
    "contact force": ("force_x", "force_y"),
}
SINCE = 5  #: minimum number of steps in fits; coarser stepping is pre-asymptotic
PAPER = 10  #: number of load steps in the paper, with one linearisation each
_PRESSURE = "contact pressure in GPa"
#: colours and markers of node-to-segment and mortar
_LOOKS = {"nts": look(0), "mortar": replace(look(1), fill="none")}
#: viridis without its ends, which have low contrast on dark or white pages
_RAMP = ("3b528b", "31678e", "297b8e", "218f8d", "1fa287", "32b67a", "56c667", "86d549",
         "bddf26")  # fmt: skip


def active(rows: Sequence[Row], contact: str) -> dict[int, list[Row]]:
    """Return the rows of the nodes in contact for each load step."""
    mine = select(rows, contact=contact)
    least = ACTIVE * max(float(r["force"]) for r in mine)
    return {
        step: [r for r in select(mine, step=step) if float(r["force"]) > least]
        for step in sorted({int(r["step"]) for r in mine})
    }


def pressure_figure(rows: Sequence[Row]) -> Figure:
    """Plot pressure against arc angle, and the active set against load steps.

    Angles include all nodes that are ever in contact, and two more on either side.
    """
    touched = {
        contact: [
            (float(r["angle"]), float(step))
            for step, loaded in active(rows, contact).items()
            for r in loaded
        ]
        for contact in _LOOKS
    }
    ever = [angle for points in touched.values() for angle, _ in points]
    angles = sorted({float(r["angle"]) for r in rows})
    margin = 2 * (angles[1] - angles[0])
    low, high = min(ever) - margin, max(ever) + margin
    angle = Axis(label="arc angle in degrees", low=low, high=high)
    last = max(int(r["step"]) for r in rows)

    def profile(contact: str, step: int) -> list[tuple[float, float]]:
        mine = select(rows, contact=contact, step=step)
        places = ((float(r["angle"]), float(r["pressure"]) / 1e9) for r in mine)
        return sorted(p for p in places if low <= p[0] <= high)

    ramp = np.array([list(bytes.fromhex(name)) for name in _RAMP])
    at = np.linspace(0, len(_RAMP) - 1, last)
    mixed = [np.interp(at, np.arange(len(_RAMP)), channel) for channel in ramp.T]
    parts = np.round(np.transpose(mixed)).astype(np.uint8)
    colours = tuple(f"#{bytes(colour).hex()}" for colour in parts)
    through, _ = labelled(
        ("", profile("nts", step), Look(colour=colour, width=1.0))
        for step, colour in enumerate(colours, 1)
    )
    methods, named = labelled(
        (CONTACTS[contact], profile(contact, last), replace(style, size=size))
        for (contact, style), size in zip(_LOOKS.items(), (4, 3), strict=True)
    )
    nodes, keys = labelled(
        (
            CONTACTS[contact],
            touched[contact],
            replace(style, size=size, edge=0.7, dash=None),
        )
        for (contact, style), size in zip(_LOOKS.items(), (3.4, 6.2), strict=True)
    )
    at_end = Panel(
        x=angle,
        y=Axis(label=_PRESSURE),
        marks=methods,
        legend=Legend(keys=named, place="upper left", size=8.5),
    )
    _, top = limits([at_end], "y")
    panels = titled(
        (
            "node-to-segment, all load steps",
            Panel(
                x=angle,
                y=Axis(label=_PRESSURE, low=0),
                marks=through,
                bar=ColourBar(label="load step", colours=colours),
            ),
        ),
        (
            f"both methods, load step {last}",
            replace(at_end, y=replace(at_end.y, low=0, high=1.3 * top)),
        ),
        (
            "active set: the nodes in contact",
            Panel(
                x=angle,
                y=Axis(
                    label="load step",
                    low=0.3,
                    high=last + 0.7,
                    most=min(last, 10),
                    integers=True,
                ),
                marks=nodes,
                span=2,
            ),
        ),
    )
    rows_of = (
        figure.Row(panels=panels[:2]),
        figure.Row(panels=panels[2:], height=0.85),
    )
    return Figure(rows=rows_of, height=5.6, legend=below(keys, 2))


def verification_figure(rows: Sequence[Row]) -> Figure:
    """Plot errors relative to exact solutions against mesh size."""
    titles = {
        "patch": ("patch test", "elements along the block", "largest stress error"),
        "hertz": ("Hertz contact", "elements per half width", "$L^2$ pressure error"),
    }
    styles = (look(0), look(1), replace(look(2), size=7, fill="none"))
    panels = []
    for problem, (title, size, error) in titles.items():
        marks, keys = labelled(
            (
                label,
                sorted(
                    (float(r["n"]), max(float(r["error"]), EXACT))
                    for r in select(rows, problem=problem, contact=contact)
                ),
                style,
            )
            for (contact, label), style in zip(CONTACTS.items(), styles, strict=True)
        )
        axis = log(f"{error}, relative")
        if problem == "patch":
            axis = replace(axis, low=EXACT / 10, high=10)
        panels.append((title, Panel(x=log(size), y=axis, marks=marks)))
    return Figure(rows=in_rows(titled(*panels), 2), height=3.2, legend=below(keys, 3))


def errors(rows: Sequence[Row], relin: int, quantity: str) -> list[tuple[int, float]]:
    """List (steps, relative error) with respect to the solution in the last row."""
    columns = QUANTITIES[quantity]
    *vectors, truth = (np.array([float(row[c]) for c in columns]) for row in rows)
    return sorted(
        (int(row["steps"]), float(np.linalg.norm(v - truth) / np.linalg.norm(truth)))
        for row, v in zip(rows[:-1], vectors, strict=True)
        if row["relin"] == relin
    )


def order(rows: Sequence[Row], relin: int, quantity: str) -> PowerLaw | None:
    """Fit error ~ (1/steps)ᵖ from SINCE steps on; None for fewer than three points."""
    kept = [
        (1 / n, e) for n, e in errors(rows, relin, quantity) if n >= SINCE and e > 0
    ]
    return power_law(*zip(*kept, strict=True)) if len(kept) >= 3 else None


def linearisations(rows: Sequence[Row]) -> list[int]:
    """List the tested numbers of linearisations per step."""
    return sorted({int(r["relin"]) for r in rows[:-1]})


def stepping_figure(rows: Sequence[Row]) -> Figure:
    """Plot the errors of both quantities against the number of steps.

    A guide line of slope −1 is above the curves.
    """
    panels = []
    for quantity in QUANTITIES:
        marks, keys = labelled(
            (f"{relin}", [p for p in errors(rows, relin, quantity) if p[1]], look(i))
            for i, relin in enumerate(linearisations(rows))
        )
        panel = Panel(x=log("load steps"), y=log("relative error"), marks=marks)
        (x0, x1), (y0, y1) = limits([panel], "x"), limits([panel], "y")
        start, stop = along((x0, x1), 0.55), along((x0, x1), 0.85)
        top = along((y0, y1), 0.93)
        guide = Series(x=(start, stop), y=(top, top * start / stop), look=GUIDE)
        name = Text(
            text="first order",
            place=(sqrt(start * stop), top * sqrt(start / stop)),
            offset=(4, 3),
            align=("left", "bottom"),
        )
        panel = replace(
            panel,
            x=replace(panel.x, low=x0, high=x1),
            y=replace(panel.y, low=y0, high=y1),
            marks=(*marks, guide),
            texts=(name,),
        )
        panels.append((quantity, panel))
    return Figure(
        rows=in_rows(titled(*panels), 2),
        height=3.1,
        legend=below(keys, len(keys), "linearisations per step"),
    )


def orders(rows: Sequence[Row]) -> Table:
    """Tabulate fitted orders, and errors at the number of steps of the paper."""
    lines = []
    for relin in linearisations(rows):
        cells = [Cell(text=str(relin), value=relin)]
        for quantity in QUANTITIES:
            law = order(rows, relin, quantity)
            error = dict(errors(rows, relin, quantity)).get(PAPER)
            cells += [
                Cell(text=exponent(law), value=law.exponent) if law else Cell(),
                Cell(text=significant(error, 2), value=error),
            ]
        lines.append(tuple(cells))
    heads = [
        head
        for q in QUANTITIES
        for head in (f"{q}: order [95 %]", f"error at {PAPER} steps")
    ]
    return Table(
        caption=f"Order in 1/steps, fitted to {SINCE} and more steps, and relative "
        f"error at {PAPER} steps. The first row is the scheme of the paper.",
        columns=("linearisations per step", *heads),
        rows=tuple(lines),
        text_columns=0,
    )
