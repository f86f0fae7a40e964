"""Convergence of solvers and of their active sets, from their histories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil, hypot
from typing import Any

import numpy as np

from mortarbench.harness import Vector
from mortarbench.reports.data.histories import CaseHistories, SolverRun
from mortarbench.reports.document.figure import (
    INK,
    WIDTH,
    Axis,
    Figure,
    Key,
    Look,
    Panel,
    Row,
    Rule,
    Segments,
    Series,
    Text,
    limits,
    numbers,
)
from mortarbench.reports.document.formatting import VERDICTS, tolerance
from mortarbench.reports.figures.style import TITLE, below, legible, look

#: step types that have markers: letter in the history, name, and marker; most of the
#: other steps are CG steps
KINDS = (("e", "expansion", "^"), ("f", "fallback", "x"), ("p", "proportioning", "o"))
WIDE = 10.0  #: ratio of longest to shortest run above which the axis is logarithmic
CLOSEST = 5.0  #: minimum distance between markers of one step type on a curve, points
COLUMNS = 4  #: number of columns of a legend
#: smallest value shown, relative to the tolerance; smaller values are due to rounding
FLOOR = 1e-5
_BESIDE = 0.8  #: width of the labels left of the axes, inches
_TOLERANCE = Look(colour=INK, width=0.6, dash=(1, 2))

Curves = Sequence[tuple[SolverRun, Vector]]


def convergence_figure(c: CaseHistories) -> Figure | None:
    """Plot projected gradient and infeasibility against work; None without both."""
    gradients = [(one, y) for one in c.runs if (y := one.gradient) is not None]
    errors = [(one, y) for one in c.runs if (y := one.infeasibility) is not None]
    rows = []
    if gradients:
        panel = _curves(c, gradients, r"$\|g^P\|\,/\,\|g^P_0\|$")
        rows.append(Row(panels=(panel,), height=2.6))
    if errors:
        tol = c.runs[0].outcome.tol
        name = Text(text="tol", place=(1, tol), inside=(True, False), offset=(3, 0))
        panel = _curves(
            c,
            errors,
            r"$\|Ax-b\|$, relative",
            texts=(name,),
            rules=(Rule(axis="y", at=tol, look=_TOLERANCE),),
        )
        rows.append(Row(panels=(panel,), height=1.9))
    if not rows:
        return None
    upper, height = rows[0].panels[0], rows[0].height
    steps = [
        mark
        for run, values in gradients or errors
        for mark in _steps(c, run, values, upper, height)
    ]
    ends = limits([upper], "y")  # markers beyond the limits are not shown
    panel = replace(
        upper,
        marks=(*upper.marks, *steps),
        y=replace(upper.y, low=ends[0], high=ends[1]),
    )
    rows[0] = replace(rows[0], panels=(panel,))
    return _figure(c, rows, c.runs, KINDS)


def active_set_figure(c: CaseHistories) -> Figure | None:
    """Plot the number of active bounds against work; None if it is not recorded.

    A second panel shows the number of active components with two bounds, if recorded.
    """
    if all(run.numbers("active") is None for run in c.runs):
        return None
    rows = []
    for name, label, height in (
        ("active", "active bounds", 2.2),
        ("two_sided", "active, two-sided", 1.6),
    ):
        counts = [(run, n) for run in c.runs if (n := run.numbers(name)) is not None]
        if counts:
            most = max(*(float(np.nanmax(n)) for _, n in counts), 1.0)
            axis = Axis(label=label, low=0, high=1.06 * most, most=6, integers=True)
            lines = (
                replace(_line(c, run, c.work(run), n), step=True) for run, n in counts
            )
            panel = Panel(x=_work(c), y=axis, marks=tuple(lines))
            rows.append(Row(panels=(panel,), height=height))
    return _figure(c, rows, [r for r in c.runs if r.numbers("active") is not None])


def marked(c: CaseHistories) -> list[str]:
    """Return the names of the step types that `convergence_figure` marks."""
    return [name for letter, name, _ in KINDS if c.taken(letter)]


def _figure(
    c: CaseHistories,
    rows: Sequence[Row],
    runs: Sequence[SolverRun],
    kinds: Sequence[tuple[str, str, str]] = (),
) -> Figure:
    """Stack panels above a common axis of work and a strip of outer iterations."""
    outer = [run for run in c.runs if run.outer_ends.any()]
    stack = list(rows)
    if outer:
        stack.append(Row(panels=(_strip(c, outer),), height=0.11 * len(outer) + 0.06))
    for i, row in enumerate(stack[:-1]):
        (panel,) = row.panels
        axis = replace(panel.x, label="", numbered=False, marked=False)
        stack[i] = replace(row, panels=(replace(panel, x=axis),))
    lines = ceil((len(c.runs) + len(marked(c))) / COLUMNS)
    height = sum(row.height for row in stack) + 0.5 + 0.2 * lines + TITLE
    keys = []
    for run in runs:
        outcome, style = run.outcome, _style(c, run)
        verdict = "" if outcome.verified else f" ({VERDICTS[outcome.verdict][1]})"
        label = legible(outcome.solver) + verdict
        keys.append(Key(label=label, look=style, solver=outcome.solver))
    for letter, name, marker in kinds:
        if c.taken(letter):
            keys.append(Key(label=name, look=_mark(marker, INK)))
    one = c.runs[0].outcome
    return Figure(
        rows=tuple(stack),
        height=height,
        legend=below(keys, COLUMNS),
        title=legible(f"{one.case}, tol {tolerance(one.tol)}", 96),
    )


def _work(c: CaseHistories) -> Axis:
    """Return the axis of work, logarithmic if runs differ much in length."""
    label = "products with $P$" if c.counted else "iterations"
    spent = [c.work(run) for run in c.runs]
    ends = [float(work.max()) for work in spent]
    if max(ends) <= WIDE * max(min(ends), 1.0):
        return Axis(label=label, low=0, high=1.02 * max(*ends, 1.0), shared="work")
    first = min(float(work[work > 0].min(initial=np.inf)) for work in spent)
    low, high = first / 1.2, 1.2 * max(ends)
    return Axis(label=label, log=True, low=low, high=high, shared="work")


def _strip(c: CaseHistories, outer: Sequence[SolverRun]) -> Panel:
    """Return a panel that marks the ends of outer iterations, one row per solver."""
    marks = tuple(
        Segments(
            ends=tuple(
                (at, -row - 0.38, at, -row + 0.38)
                for at in c.work(run)[run.outer_ends].tolist()
            ),
            colour=_style(c, run).colour,
            solver=run.outcome.solver,
            runs=((run.record.identity,),),
        )
        for row, run in enumerate(outer)
    )
    axis = Axis(label="outer", ticks=(), line=False, low=0.4 - len(outer), high=0.6)
    return Panel(x=_work(c), y=axis, marks=marks, grid="none")


def _curves(c: CaseHistories, drawn: Curves, label: str, **more: Any) -> Panel:
    """Return a panel of curves of positive values on a logarithmic axis."""
    marks = []
    for run, values in drawn:
        seen = values > 0  # excludes NaN
        marks.append(_line(c, run, c.work(run)[seen], values[seen]))
    axis = Axis(label=label, log=True, most=8)
    panel = Panel(x=_work(c), y=axis, marks=tuple(marks), **more)
    low, high = limits([panel], "y")
    floor = min(FLOOR * drawn[0][0].outcome.tol, high / 10)
    return replace(panel, y=replace(axis, low=max(low, floor), high=high))


def _line(c: CaseHistories, run: SolverRun, x: Vector, y: Vector) -> Series:
    return Series(
        x=numbers(x),
        y=numbers(y),
        look=_style(c, run),
        solver=run.outcome.solver,
        runs=((run.record.identity,),),
    )


def _steps(
    c: CaseHistories, run: SolverRun, values: Vector, panel: Panel, height: float
) -> list[Series]:
    """Mark the step types on a curve, without overlapping markers of the same type."""
    markers = []
    ends = limits([panel], "x"), limits([panel], "y")
    sizes = 72 * (WIDTH - _BESIDE), 72 * height  # points
    for letter, _, marker in KINDS:
        at = np.flatnonzero(run.steps(letter) & (values > 0))
        xy = np.column_stack([c.work(run)[at], values[at]])
        if panel.x.log:
            xy = xy[xy[:, 0] > 0]
        places = []
        for column, axis, along, size in zip(
            xy.T, (panel.x, panel.y), ends, sizes, strict=True
        ):
            scale = np.log10 if axis.log else np.asarray
            low, high = scale(along)
            places.append(size * (scale(column) - low) / (high - low))
        kept = list[int]()
        for i, (x, y) in enumerate(zip(*places, strict=True)):
            if (
                not kept
                or hypot(x - places[0][kept[-1]], y - places[1][kept[-1]]) >= CLOSEST
            ):
                kept.append(i)
        if kept:
            style = _mark(marker, _style(c, run).colour)
            markers.append(replace(_line(c, run, *xy[kept].T), look=style))
    return markers


def _style(c: CaseHistories, run: SolverRun) -> Look:
    """Return colour and dashes of a solver; markers are reserved for step types."""
    return replace(look(c.solvers.index(run.outcome.solver)), marker="")


def _mark(marker: str, colour: str) -> Look:
    return Look(
        colour=colour,
        marker=marker,
        dash=None,
        size=3.2,
        edge=0.7,
        fill="none" if marker == "^" else "",
    )
