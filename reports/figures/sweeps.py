"""Sweeps of tolerances: the error that was reached against the time that it took."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import isfinite

from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.data.time_at_accuracy import SMALLEST, counts
from mortarbench.reports.document.figure import (
    INK,
    Figure,
    Intervals,
    Key,
    Look,
    Panel,
    Rule,
    Series,
    in_rows,
)
from mortarbench.reports.figures.style import (
    DASHED,
    DOTTED,
    LEGEND_LINE,
    below,
    legible,
    log,
    look,
    run_ids,
    solver_keys,
)

SHARE = 0.1  #: of the discretisation error that a solver may add
_COLUMNS = 4  #: of the legend
_LEAST = 1e-17  #: residuals below, zero among them, are drawn there
_MESH = Look(colour=INK, width=0.8, dash=DASHED)
_TENTH = Look(colour=INK, width=0.8, dash=DOTTED)

Sweep = Mapping[str, Sequence[Outcome]]  #: solver → its answers, by tolerance


def sweep_figure(swept: Sequence[tuple[str, Sweep]], solvers: Sequence[str]) -> Figure:
    """Draw the largest residual against the time, a panel for each (case, sweep).

    solvers : of the whole report, which their looks go by
    """
    panels = [
        Panel(
            x=log("median total time in s"),
            y=log("worst residual"),
            title=legible(case),
            marks=tuple(
                mark
                for solver, outcomes in row.items()
                for mark in _residuals(outcomes, look(solvers.index(solver)))
            ),
            rules=(
                Rule(
                    axis="y", at=next(iter(row.values()))[0].allowed,
                    look=Look(colour=INK, width=0.8),
                ),
            ),
        )
        for case, row in swept
    ]  # fmt: skip
    return _figure(panels, solver_keys(_present(swept, solvers), solvers))


def _residuals(outcomes: Sequence[Outcome], style: Look) -> list[Series]:
    """Join the answers of one solver; hollow where they are not verified."""
    points = [
        (t.value, max(o.worst, _LEAST), run_ids(o.records), o.verified)
        for o in outcomes
        if o.worst is not None and (t := o.seconds("total")) is not None
    ]
    made = []
    hollow, filled = replace(style, fill="none"), replace(style, dash=None)
    for chosen, how in ((points, hollow), ([p for p in points if p[-1]], filled)):
        if chosen:
            x, y, runs, _ = zip(*chosen, strict=True)
            made.append(
                Series(x=x, y=y, runs=runs, look=how, solver=outcomes[0].solver)
            )
    return made


def certified_figure(
    swept: Sequence[tuple[str, Sweep]],
    solvers: Sequence[str],
    meshes: Mapping[str, float],
) -> Figure:
    """Draw the certified error against the time, a panel for each (case, sweep).

    solvers : of the whole report, which their looks go by
    meshes : physical case → its discretisation error, where one is known
    """
    panels, lines = [], []
    for case, row in swept:
        error = meshes.get(next(iter(row.values()))[0].physical)
        if error is not None:
            lines = [("discretisation error", _MESH), ("a tenth of it", _TENTH)]
        names = [s for s in solvers if s in row]
        curves = [_certified(row[s], look(solvers.index(s))) for s in names]
        panels.append(
            Panel(
                x=log("median total time in s"),
                y=log("certified relative error"),
                title=legible(case),
                marks=tuple(mark for marks in curves for mark in marks),
                rules=() if error is None else (
                    Rule(axis="y", at=error, look=_MESH),
                    Rule(axis="y", at=SHARE * error, look=_TENTH),
                ),
            )
        )  # fmt: skip
    keys = solver_keys(_present(swept, solvers), solvers)
    return _figure(panels, (*keys, *(Key(label=s, look=how) for s, how in lines)))


def _certified(outcomes: Sequence[Outcome], style: Look) -> list[Series]:
    """Join the points that count; mark the others hollow, on their own."""
    made = []
    for counted in (True, False):
        points = [
            (t, max(e, SMALLEST), run_ids(o.records))
            for o in outcomes
            if (e := o.largest("energy_bound")) is not None and isfinite(e)
            and (t := o.seconds("total")) is not None and counts(o) is counted
        ]  # fmt: skip
        if not points:
            continue
        times, errors, runs = zip(*points, strict=True)
        low, high = tuple(t.low for t in times), tuple(t.high for t in times)
        made.append(
            Series(
                x=tuple(t.value for t in times), y=errors, runs=runs,
                look=style if counted else replace(style, fill="none", dash=None),
                solver=outcomes[0].solver,
                intervals=Intervals(
                    low=low, high=high, along="x", cap=1.5, width=0.6, opacity=0.55
                ),
            )
        )  # fmt: skip
    return made


def _present(swept: Sequence[tuple[str, Sweep]], solvers: Sequence[str]) -> list[str]:
    return [s for s in solvers if any(s in row for _, row in swept)]


def _figure(panels: Sequence[Panel], keys: Sequence[Key]) -> Figure:
    rows = in_rows(panels, min(len(panels), 2))
    legend = LEGEND_LINE * -(-len(keys) // _COLUMNS)
    return Figure(
        rows=rows,
        height=0.3 + legend + 2.6 * len(rows),
        legend=below(keys, _COLUMNS),
    )
