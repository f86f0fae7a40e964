"""Pictures of how solvers converge and find the active set, from their histories."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from harness import Vector
from reports.data.histories import CaseHistories, SolverRun
from reports.document.formatting import VERDICTS
from reports.figures.provenance import behind
from reports.figures.style import INK, STYLE, legible, look

#: letter of a step, its name, and its mark; the others, CG above all, are bare
KINDS = (("e", "expansion", "^"), ("f", "fallback", "x"), ("p", "proportioning", "o"))
WIDE = 10.0  #: ratio of the longest run to the shortest that makes their axis log
CLOSEST = 5.0  #: distance of marks of one kind on a curve, in points
COLUMNS = 4  #: of a legend
FLOOR = 1e-5  #: times the tolerance: less is rounding, and not shown


def convergence_figure(c: CaseHistories) -> Figure | None:
    """Draw projected gradient and infeasibility over the work; None without either."""
    gradients = [(one, y) for one in c.runs if (y := one.gradient) is not None]
    errors = [(one, y) for one in c.runs if (y := one.infeasibility) is not None]
    heights = [2.6] * bool(gradients) + [1.9] * bool(errors)
    if not heights:
        return None
    with rc_context(STYLE):
        figure, panels = _panels(c, heights)
        if gradients:
            panels[0].set_ylabel(r"$\|g^P\|\,/\,\|g^P_0\|$")
            _curves(panels[0], c, gradients)
        if errors:
            panels[-1].set_ylabel(r"$\|Ax-b\|$, relative")
            _curves(panels[-1], c, errors)
            _tolerance(panels[-1], c.runs[0].outcome.tol)
        for run, values in gradients or errors:
            _mark_steps(panels[0], c, run, values)
        _legend(figure, c, c.runs, KINDS)
    return figure


def active_set_figure(c: CaseHistories) -> Figure | None:
    """Draw the number of active bounds over the work; None if nobody counts them."""
    counts = [(one, n) for one in c.runs if (n := one.active) is not None]
    if not counts:
        return None
    with rc_context(STYLE):
        figure, (axes,) = _panels(c, [2.2])
        for run, active in counts:
            style = _style(c, run)
            (line,) = axes.plot(c.work(run), active, drawstyle="steps-post", **style)
            behind(line, [[run.record]])
        axes.set_ylabel("active bounds")
        axes.set_ylim(0, 1.06 * max(*(float(np.nanmax(n)) for _, n in counts), 1.0))
        axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
        _legend(figure, c, [run for run, _ in counts])
    return figure


def marked(c: CaseHistories) -> list[str]:
    """Name the kinds of steps that `convergence_figure` marks."""
    return [name for letter, name, _ in KINDS if c.taken(letter)]


def _panels(c: CaseHistories, heights: list[float]) -> tuple[Figure, list[Axes]]:
    """Stack panels over one axis of work, with a strip for outer iterations below."""
    outer = [run for run in c.runs if run.outer_ends.any()]
    parts = heights + [0.11 * len(outer) + 0.06] * bool(outer)
    entries = len(c.runs) + len(marked(c))
    legend = 0.2 * ceil(entries / COLUMNS)
    figure = Figure(figsize=(6.9, sum(parts) + 0.5 + legend))
    stack = figure.subplots(
        len(parts), 1, sharex=True, squeeze=False, height_ratios=parts
    )[:, 0]
    ends = [float(c.work(run).max()) for run in c.runs]
    if max(ends) > WIDE * max(min(ends), 1.0):
        stack[-1].set_xscale("log")
    else:
        stack[-1].set_xlim(0, 1.02 * max(*ends, 1.0))
    stack[-1].set_xlabel("products with $P$" if c.counted else "iterations")
    for axes in stack[:-1]:
        axes.tick_params(axis="x", which="both", bottom=False)
    for axes in stack[: len(heights)]:
        axes.grid(visible=True, color="#8a93a0", alpha=0.3, linewidth=0.4)
        axes.set_axisbelow(True)
    if outer:
        _strip(stack[-1], c, outer)
    return figure, list(stack[: len(heights)])


def _strip(axes: Axes, c: CaseHistories, outer: Sequence[SolverRun]) -> None:
    """Put a tick where an outer iteration ends, a row for each solver."""
    for row, run in enumerate(outer):
        ticks = c.work(run)[run.outer_ends]
        colour = _style(c, run)["color"]
        ends = axes.vlines(ticks, -row - 0.38, -row + 0.38, color=colour, linewidth=0.8)
        behind(ends, [[run.record]])
    axes.set(ylim=(-len(outer) + 0.4, 0.6), yticks=[])
    axes.set_ylabel("outer", rotation=0, ha="right", va="center", fontsize=8.5)
    axes.spines["left"].set_visible(False)


def _curves(
    axes: Axes, c: CaseHistories, drawn: Sequence[tuple[SolverRun, Vector]]
) -> None:
    """Plot positive values on a logarithmic axis."""
    for run, values in drawn:
        seen = _positive(values)
        (line,) = axes.plot(c.work(run)[seen], values[seen], **_style(c, run))
        behind(line, [[run.record]])
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    floor = FLOOR * drawn[0][0].outcome.tol
    axes.set_ylim(bottom=max(low, min(floor, high / 10)))
    axes.yaxis.set_major_locator(LogLocator(numticks=8))
    axes.yaxis.set_minor_locator(NullLocator())


def _mark_steps(axes: Axes, c: CaseHistories, run: SolverRun, values: Vector) -> None:
    """Mark the kinds of steps on a curve, except where marks would overlap."""
    axes.autoscale_view()  # which is otherwise put off until the figure is drawn
    point = axes.figure.dpi / 72
    for letter, _, marker in KINDS:
        at = np.flatnonzero(run.steps(letter) & _positive(values))
        points = np.column_stack([c.work(run)[at], values[at]])
        apart = _apart(axes.transData.transform(points) / point)
        (line,) = axes.plot(*points[apart].T, **_mark(marker, _style(c, run)["color"]))
        behind(line, [[run.record]])


def _apart(places: NDArray[np.float64]) -> list[int]:
    """Choose points, the first one first, none closer than CLOSEST to the one before.

    places : (points, 2) in points of typography
    """
    kept: list[int] = []
    for i, place in enumerate(places):
        if not kept or np.hypot(*(place - places[kept[-1]])) >= CLOSEST:
            kept.append(i)
    return kept


def _tolerance(axes: Axes, tol: float) -> None:
    """Draw what was asked for."""
    axes.axhline(tol, color=INK, linewidth=0.6, linestyle=(0, (1, 2)))
    axes.annotate(
        "tol", (1, tol), xycoords=("axes fraction", "data"), xytext=(3, 0),
        textcoords="offset points", va="center", fontsize=8.5,
    )  # fmt: skip


def _positive(values: Vector) -> NDArray[np.bool_]:
    """Tell what has a logarithm."""
    return values > 0  # NaN is not


def _style(c: CaseHistories, run: SolverRun) -> dict[str, Any]:
    """Colour and dashes of a solver, without the marker: that tells the step."""
    return {**look(c.solvers.index(run.outcome.solver)), "marker": "none"}


def _mark(marker: str, colour: str) -> dict[str, Any]:
    return {
        "linestyle": "none", "marker": marker, "color": colour, "markersize": 3.2,
        "markerfacecolor": "none" if marker == "^" else colour, "markeredgewidth": 0.7,
    }  # fmt: skip


def _legend(
    figure: Figure,
    c: CaseHistories,
    runs: Sequence[SolverRun],
    kinds: Sequence[tuple[str, str, str]] = (),
) -> None:
    """Name the solvers, with the verdict where it is not good, and the marks."""
    keys = [Line2D([], [], **_style(c, run)) for run in runs]
    names = [_name(run) for run in runs]
    for letter, name, marker in kinds:
        if c.taken(letter):
            keys.append(Line2D([], [], **_mark(marker, INK)))
            names.append(name)
    figure.legend(keys, names, loc="outside lower center", ncols=COLUMNS)


def _name(run: SolverRun) -> str:
    outcome = run.outcome
    verdict = "" if outcome.verified else f" ({VERDICTS[outcome.verdict][1]})"
    return legible(outcome.solver) + verdict
