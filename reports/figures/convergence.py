"""How solvers converge and find the active set, from their histories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil, hypot, log10

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector
from mortarbench.reports.data.histories import CaseHistories, SolverRun
from mortarbench.reports.document.figure import (
    INK,
    WIDTH,
    Axis,
    Figure,
    Key,
    Legend,
    Limits,
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

#: letter of a step, its name, and its mark; the others, CG above all, are bare
KINDS = (("e", "expansion", "^"), ("f", "fallback", "x"), ("p", "proportioning", "o"))
WIDE = 10.0  #: ratio of the longest run to the shortest that makes their axis log
CLOSEST = 5.0  #: distance of marks of one kind on a curve, in points
COLUMNS = 4  #: of a legend
FLOOR = 1e-5  #: times the tolerance: less is rounding, and not shown
_BESIDE = 0.8  #: width of what is left of the axes, inches
_TOLERANCE = Look(colour=INK, width=0.6, dash=(1, 2))

Curves = Sequence[tuple[SolverRun, Vector]]


def convergence_figure(c: CaseHistories) -> Figure | None:
    """Draw projected gradient and infeasibility over the work; None without either."""
    gradients = [(one, y) for one in c.runs if (y := one.gradient) is not None]
    errors = [(one, y) for one in c.runs if (y := one.infeasibility) is not None]
    tol = c.runs[0].outcome.tol
    rows = []
    if gradients:
        panel = _curves(c, gradients, r"$\|g^P\|\,/\,\|g^P_0\|$")
        rows.append(Row(panels=(panel,), height=2.6))
    if errors:
        panel = _curves(c, errors, r"$\|Ax-b\|$, relative", tol)
        rows.append(Row(panels=(panel,), height=1.9))
    if not rows:
        return None
    upper, height = rows[0].panels[0], rows[0].height
    steps = [
        mark
        for run, values in gradients or errors
        for mark in _steps(c, run, values, upper, height)
    ]
    ends = limits([upper], "y")  # marks beyond them are not shown
    panel = replace(
        upper,
        marks=(*upper.marks, *steps),
        y=replace(upper.y, low=ends[0], high=ends[1]),
    )
    rows[0] = replace(rows[0], panels=(panel,))
    return _figure(c, rows, c.runs, KINDS)


def active_set_figure(c: CaseHistories) -> Figure | None:
    """Draw the number of active bounds over the work; None if nobody counts them.

    Below them those of components between two bounds, where there are some.
    """
    counts = [(one, n) for one in c.runs if (n := one.active) is not None]
    if not counts:
        return None
    slipping = [(one, n) for one in c.runs if (n := one.two_sided) is not None]
    rows = [Row(panels=(_counts(c, counts, "active bounds"),), height=2.2)]
    if slipping:
        panel = _counts(c, slipping, "of two bounds")
        rows.append(Row(panels=(panel,), height=1.6))
    return _figure(c, rows, [run for run, _ in counts])


def _counts(c: CaseHistories, counts: Curves, label: str) -> Panel:
    """Draw numbers of components over the work, as steps."""
    most = max(*(float(np.nanmax(n)) for _, n in counts), 1.0)
    return Panel(
        x=_work(c),
        y=Axis(label=label, low=0, high=1.06 * most, most=6, integers=True),
        marks=tuple(
            replace(_line(c, run, c.work(run), active), step=True)
            for run, active in counts
        ),
    )


def marked(c: CaseHistories) -> list[str]:
    """Name the kinds of steps that `convergence_figure` marks."""
    return [name for letter, name, _ in KINDS if c.taken(letter)]


def _figure(
    c: CaseHistories,
    rows: Sequence[Row],
    runs: Sequence[SolverRun],
    kinds: Sequence[tuple[str, str, str]] = (),
) -> Figure:
    """Stack panels over one axis of work, with a strip for outer iterations below."""
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
    one = c.runs[0].outcome
    return Figure(
        rows=tuple(stack), height=height, legend=_legend(c, runs, kinds),
        title=legible(f"{one.case}, tol {tolerance(one.tol)}", 96),
    )  # fmt: skip


def _work(c: CaseHistories) -> Axis:
    """Make the axis of work: logarithmic where runs differ much in length."""
    label = "products with $P$" if c.counted else "iterations"
    spent = [c.work(run) for run in c.runs]
    ends = [float(work.max()) for work in spent]
    if max(ends) <= WIDE * max(min(ends), 1.0):
        return Axis(label=label, low=0, high=1.02 * max(*ends, 1.0), shared="work")
    first = min(float(work[work > 0].min(initial=np.inf)) for work in spent)
    low, high = first / 1.2, 1.2 * max(ends)
    return Axis(label=label, log=True, low=low, high=high, shared="work")


def _strip(c: CaseHistories, outer: Sequence[SolverRun]) -> Panel:
    """Put a tick where an outer iteration ends, a row for each solver."""
    marks = tuple(
        Segments(
            ends=tuple(
                (at, -row - 0.38, at, -row + 0.38)
                for at in c.work(run)[run.outer_ends].tolist()
            ),
            colour=_style(c, run).colour, solver=run.outcome.solver,
            runs=((run.record.run_id,),),
        )
        for row, run in enumerate(outer)
    )  # fmt: skip
    axis = Axis(label="outer", ticks=(), line=False, low=0.4 - len(outer), high=0.6)
    return Panel(x=_work(c), y=axis, marks=marks, grid="none")


def _curves(
    c: CaseHistories, drawn: Curves, label: str, tol: float | None = None
) -> Panel:
    """Make curves of positive values on a logarithmic axis; a rule where tol is."""
    marks = []
    for run, values in drawn:
        seen = _positive(values)
        marks.append(_line(c, run, c.work(run)[seen], values[seen]))
    rules, texts = [], []
    if tol is not None:
        rules.append(Rule(axis="y", at=tol, look=_TOLERANCE))
        texts.append(
            Text(text="tol", place=(1, tol), inside=(True, False), offset=(3, 0))
        )
    axis = Axis(label=label, log=True, most=8)
    panel = Panel(
        x=_work(c), y=axis, marks=tuple(marks), rules=tuple(rules), texts=tuple(texts)
    )
    low, high = limits([panel], "y")
    floor = min(FLOOR * drawn[0][0].outcome.tol, high / 10)
    return replace(panel, y=replace(axis, low=max(low, floor), high=high))


def _line(c: CaseHistories, run: SolverRun, x: Vector, y: Vector) -> Series:
    return Series(
        x=numbers(x), y=numbers(y), look=_style(c, run), solver=run.outcome.solver,
        runs=((run.record.run_id,),),
    )  # fmt: skip


def _steps(
    c: CaseHistories, run: SolverRun, values: Vector, panel: Panel, height: float
) -> list[Series]:
    """Mark the kinds of steps on a curve, except where marks would overlap."""
    size = 72 * (WIDTH - _BESIDE), 72 * height  # points
    ends = limits([panel], "x"), limits([panel], "y")
    logs = panel.x.log, panel.y.log
    made = []
    for letter, _, marker in KINDS:
        at = np.flatnonzero(run.steps(letter) & _positive(values))
        xy = np.column_stack([c.work(run)[at], values[at]])
        if panel.x.log:
            xy = xy[xy[:, 0] > 0]
        places = [tuple(map(_place, point, ends, logs, size)) for point in xy.tolist()]
        kept = xy[_apart(places)]
        if kept.size:
            style = _mark(marker, _style(c, run).colour)
            made.append(replace(_line(c, run, *kept.T), look=style))
    return made


def _place(value: float, ends: Limits, log: bool, size: float) -> float:
    """Find how far along an axis of that size a value lies."""
    low, high, at = (log10(v) for v in (*ends, value)) if log else (*ends, value)
    return size * (at - low) / (high - low)


def _apart(places: Sequence[tuple[float, ...]]) -> list[int]:
    """Choose points, the first one first, none closer than CLOSEST to the one before.

    places : of (x, y) in points of typography
    """
    kept: list[int] = []
    for i, (x, y) in enumerate(places):
        if not kept:
            kept.append(i)
            continue
        before = places[kept[-1]]
        if hypot(x - before[0], y - before[1]) >= CLOSEST:
            kept.append(i)
    return kept


def _positive(values: Vector) -> NDArray[np.bool_]:
    """Tell what has a logarithm."""
    return values > 0  # NaN is not


def _style(c: CaseHistories, run: SolverRun) -> Look:
    """Colour and dashes of a solver, without the marker: that tells the step."""
    return replace(look(c.solvers.index(run.outcome.solver)), marker="")


def _mark(marker: str, colour: str) -> Look:
    return Look(
        colour=colour, marker=marker, dash=None, size=3.2, edge=0.7,
        fill="none" if marker == "^" else "",
    )  # fmt: skip


def _legend(
    c: CaseHistories,
    runs: Sequence[SolverRun],
    kinds: Sequence[tuple[str, str, str]],
) -> Legend:
    """Name the solvers, with the verdict where it is not good, and the marks."""
    keys = [
        Key(label=_name(run), look=_style(c, run), solver=run.outcome.solver)
        for run in runs
    ]
    for letter, name, marker in kinds:
        if c.taken(letter):
            keys.append(Key(label=name, look=_mark(marker, INK)))
    return below(keys, COLUMNS)


def _name(run: SolverRun) -> str:
    outcome = run.outcome
    verdict = "" if outcome.verified else f" ({VERDICTS[outcome.verdict][1]})"
    return legible(outcome.solver) + verdict
