"""Ratios of times, after over before, by solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mortarbench.reports.compare.changes import Comparison, Pair, mean_ratio
from mortarbench.reports.document.figure import (
    INK,
    Axis,
    Figure,
    Look,
    Mark,
    Panel,
    Row,
    Rule,
    Segments,
    Series,
    categories,
    limits,
)
from mortarbench.reports.figures.style import legible, look, run_ids

_ROW = 0.42  #: height of a solver's row, inches
_SHIFT = 0.16  #: offset of cells above the middle of a row, and of the mean below it


def ratios_figure(c: Comparison) -> Figure:
    """Draw a row per solver: its cells as dots, its mean as a bar with its interval."""
    solvers = [s for s in c.solvers if any(p.log is not None for p in c.of(s))]
    marks = [
        mark
        for row, solver in enumerate(solvers)
        for mark in _row(
            solver,
            -row,
            [p for p in c.of(solver) if p.log is not None],
            look(c.after.solvers.index(solver)).colour,
        )
    ]
    panel = Panel(
        x=Axis(label="time after / time before", log=True, plain=True),
        y=categories([legible(s) for s in solvers]),
        marks=tuple(marks),
        rules=(Rule(axis="x", at=1.0, look=Look(colour=INK, width=0.8)),),
        grid="x",
    )
    low, high = limits([panel], "x")
    axis = replace(panel.x, low=min(low, 1 / 1.1), high=max(high, 1.1))
    return Figure(
        rows=(Row(panels=(replace(panel, x=axis),)),),
        height=0.8 + _ROW * max(len(solvers), 1),
    )


def _row(solver: str, row: int, pairs: Sequence[Pair], colour: str) -> list[Mark]:
    """Draw the cells of one solver above its mean."""
    made: list[Mark] = []
    for changed in (False, True):
        chosen = [p for p in pairs if (p.change != 0) is changed]
        if chosen:
            style = Look(
                colour=colour,
                marker="o",
                dash=None,
                size=4,
                fill="" if changed else "none",
            )
            made.append(
                Series(
                    x=tuple(float(np.exp(p.log or 0.0)) for p in chosen),
                    y=(row + _SHIFT,) * len(chosen),
                    look=style,
                    solver=solver,
                    runs=tuple(run_ids(p.after.records) for p in chosen),
                )
            )
    mean = mean_ratio(pairs)
    if mean is None:
        return made
    below = row - _SHIFT
    if mean.low > 0:
        ends = ((mean.low, below, mean.high, below),)
        made.append(Segments(ends=ends, colour=colour, width=2.2, solver=solver))
    style = Look(colour=INK, marker="|", dash=None, size=9)
    made.append(Series(x=(mean.value,), y=(below,), look=style, solver=solver))
    return made
