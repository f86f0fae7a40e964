"""Sweeps of tolerances against certified errors: curves, and times at matched error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from harness import Verdict
from harness.crossval.discretisation import Discretisation
from reports.data.evidence import Evidence, Outcome
from reports.data.time_at_accuracy import (
    SMALLEST,
    TimeAtAccuracy,
    counts,
    time_at_accuracy,
)
from reports.document.formatting import ABSENT, TIMED, clean, power, seconds, tolerance
from reports.document.layout import Cell, Picture, Table, name_cell
from reports.figures.style import INK, LEGEND_LINE, STYLE, legible, log_log, look
from reports.statistics.intervals import COVERAGE

ERRORS = (1e-2, 1e-4, 1e-6)  #: at which times are compared
LEAST = 3  #: tolerances that make a sweep
SHARE = 0.1  #: of the discretisation error that a solver may add
_PANELS = 4  #: cases that are drawn; all are tabulated
_COLUMNS = 4  #: of the legend
_MESH: dict[str, Any] = {"color": INK, "linewidth": 0.8, "linestyle": "--"}
_TENTH: dict[str, Any] = {**_MESH, "linestyle": ":"}

Sweeps = Mapping[str, Mapping[str, Sequence[Outcome]]]  #: case → solver → by tolerance


def certified_sweeps(evidence: Evidence) -> dict[str, dict[str, list[Outcome]]]:
    """Collect the cases with certified errors at three tolerances or more."""
    found: dict[str, dict[str, list[Outcome]]] = {}
    for o in sorted(evidence.flat, key=lambda o: -o.tol):
        found.setdefault(o.case, {}).setdefault(o.solver, []).append(o)
    return {case: row for case, row in sorted(found.items()) if _swept(row)}


def _swept(row: Mapping[str, Sequence[Outcome]]) -> bool:
    bounded = {
        o.tol for outcomes in row.values() for o in outcomes
        if o.largest("energy_bound") is not None
    }  # fmt: skip
    return len(bounded) >= LEAST


def time_at_accuracy_table(swept: Sweeps, solvers: Sequence[str]) -> Table:
    """Tabulate the times at matched certified errors."""
    present = [s for s in solvers if any(s in row for row in swept.values())]
    rows = []
    for case, row in swept.items():
        for error in ERRORS:
            found = {
                s: time_at_accuracy(outcomes, error) for s, outcomes in row.items()
            }
            kinds = places({s: m for s, m in found.items() if not row[s][0].first.arm})
            cells = [
                _cell(found.get(s), row.get(s, ()), kinds.get(s, "")) for s in present
            ]
            rows.append(
                (name_cell(case), Cell(text=tolerance(error), value=error), *cells)
            )
    return Table(
        caption="Total time at matched certified error: relative, in the energy norm.",
        notes=(
            "Interpolated between the tolerances of the sweep, monotone and linear in "
            f"logarithms, never beyond them; in brackets the {COVERAGE:.0%} interval "
            "of a bootstrap over the repeats. ≤: the answer at the loosest tolerance "
            "is better than that already, and took so long; at this error it may take "
            "less than any other. Bold: the fastest of its row, where no other has a "
            "≤; ≈: the interval overlaps that of the fastest time without a ≤, so that "
            "this run does not tell them apart.",
            TIMED,
        ),
        columns=("case", "error", *(clean(s, 40) for s in present)),
        rows=tuple(rows),
    )


def places(found: Mapping[str, TimeAtAccuracy]) -> dict[str, str]:
    """Rank the times of a row: "best", "tied" or neither, by solver.

    What is only bounded from above has no place in it, and then nothing is best.
    """
    known = {s: m.time for s, m in found.items() if m.kind == "between" and m.time}
    if not known:
        return {}
    fastest = min(known.values(), key=lambda t: t.value)
    best = "" if any(m.kind == "looser" for m in found.values()) else "best"
    return {
        s: best if t.value == fastest.value
        else "tied" if t.low <= fastest.high and t.samples > 1
        else ""
        for s, t in known.items()
    }  # fmt: skip


def _cell(found: TimeAtAccuracy | None, tried: Sequence[Outcome], kind: str) -> Cell:
    if found is None:
        return Cell(text=ABSENT)
    reached = [o for o in tried if counts(o)]
    if found.time is None:
        if all(o.verdict is Verdict.DECLINED for o in tried):
            return Cell(text="declined", kind="quiet")
        closest = min((o.largest("energy_bound") or 0.0 for o in reached), default=None)
        after = "" if closest is None else f"at best {power(closest)}"
        return Cell(text="not reached", after=after, kind="quiet")
    runs = " ".join(i for o in reached for i in o.run_ids)
    looser = found.kind == "looser"
    return Cell(
        text=("≤ " if looser else "") + seconds(found.time),
        after="below the loosest tolerance" if looser else "",
        symbol="≈" if kind == "tied" else "",
        kind=kind,
        value=found.time.value,
        title=clean(f"from runs {runs}", 400),
    )


def certified_picture(
    swept: Sweeps, solvers: Sequence[str], meshes: Mapping[str, Discretisation]
) -> Picture:
    """Draw certified error against time for the first few cases."""
    drawn = dict([*swept.items()][:_PANELS])
    rest = f" The first {len(drawn)} of {len(swept)} cases." * (len(swept) > len(drawn))
    lines = (
        " Below a tenth of the discretisation error, more digits say no more about the "
        "bodies; where refinement has no limit, it is the change to the next mesh."
    ) * any(_mesh_error(row, meshes) for row in drawn.values())
    return Picture(
        name="certified",
        caption="Certified relative error in the energy norm against the median total "
        "time, a line per solver through the tolerances asked for. Bars: interval of "
        "the median. Filled: the solver's own test ended the solve; hollow: a limit "
        f"did, or it gave up.{lines}{rest}",
        figure=_figure(drawn, solvers, meshes),
    )


def _mesh_error(
    row: Mapping[str, Sequence[Outcome]], meshes: Mapping[str, Discretisation]
) -> float | None:
    physical = next(iter(row.values()))[0].physical
    mesh = meshes.get(physical)
    return mesh.error if mesh and mesh.kind in ("limit", "change") else None


def _figure(
    swept: Sweeps, solvers: Sequence[str], meshes: Mapping[str, Discretisation]
) -> Figure:
    columns = min(len(swept), 2)
    lines = -(-len(swept) // columns)
    names = [s for s in solvers if any(s in row for row in swept.values())]
    with rc_context(STYLE):
        legend = LEGEND_LINE * -(-(len(names) + 2) // _COLUMNS)
        figure = Figure(figsize=(6.9, 0.3 + legend + 2.6 * lines))
        grid = figure.subplots(lines, columns, squeeze=False).ravel()
        for axes, (case, row) in zip(grid, swept.items(), strict=False):
            for solver in (s for s in names if s in row):
                _curve(axes, row[solver], look(solvers.index(solver)))
            if error := _mesh_error(row, meshes):
                axes.axhline(error, **_MESH)
                axes.axhline(SHARE * error, **_TENTH)
            axes.set_title(legible(case))
            log_log(axes, "median total time in s", "certified relative error")
        for axes in grid[len(swept) :]:
            axes.set_axis_off()
        keys = [Line2D([], [], **look(solvers.index(s))) for s in names]
        labels = [legible(s) for s in names]
        if any(_mesh_error(row, meshes) for row in swept.values()):
            keys += [Line2D([], [], **style) for style in (_MESH, _TENTH)]
            labels += ["discretisation error", "a tenth of it"]
        figure.legend(keys, labels, loc="outside lower center", ncols=_COLUMNS)
    return figure


def _curve(axes: Axes, outcomes: Sequence[Outcome], style: dict[str, object]) -> None:
    """Join the points that count; mark the others hollow, on their own."""
    shown = [
        (t.value, t.low, t.high, max(e, SMALLEST), counts(o))
        for o in outcomes
        if (e := o.largest("energy_bound")) is not None and np.isfinite(e)
        and (t := o.seconds("total")) is not None
    ]  # fmt: skip
    for counted in (True, False):
        points = [p[:4] for p in shown if p[4] is counted]
        if not points:
            continue
        t, low, high, error = np.array(points, dtype=float).T
        other = {} if counted else {"markerfacecolor": "none", "linestyle": "none"}
        axes.plot(t, error, **{**style, **other})  # type: ignore[arg-type]
        axes.errorbar(
            t, error, xerr=[t - low, high - t], fmt="none", color=style["color"],
            capsize=1.5, elinewidth=0.6, capthick=0.6, alpha=0.55,
        )  # fmt: skip
