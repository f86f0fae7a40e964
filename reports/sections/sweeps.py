"""Time to accuracy: the tolerance asked for is swept, every answer is judged at one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from harness import Verdict
from harness.crossval.discretisation import read_discretisation
from reports.data.cells import source
from reports.data.evidence import Evidence, Outcome
from reports.document.formatting import ABSENT, TIMED, clean, seconds, tolerance
from reports.document.layout import Cell, Picture, Section, Table, name_cell
from reports.figures.provenance import behind
from reports.figures.style import INK, LEGEND_LINE, STYLE, legible, log_log, look
from reports.sections.certified import (
    certified_picture,
    certified_sweeps,
    time_at_accuracy_table,
)

LEGEND_COLUMNS = 4
_PANELS = 4  #: cases that are drawn; all are tabulated
_LEAST = 1e-17  #: residuals below, zero among them, are drawn there

Key = tuple[str, float]  #: case, and the accuracy that answers are judged at


def accuracy(evidence: Evidence) -> Section | None:
    """Tabulate and draw every sweep; None where there is none.

    Certified errors where there are any; the largest residual elsewhere.
    """
    swept, certified = _sweeps(evidence), certified_sweeps(evidence)
    if not swept and not certified:
        return None
    tables, pictures, prose = [], [], []
    if certified:
        meshes = read_discretisation(evidence.directory)
        prose.append(
            "Solvers test their tolerance in norms of their own, so that equal "
            "tolerances are unequal demands. Here the tolerance asked for is swept, "
            "the error of every answer is certified, and solvers are compared by the "
            "time at equal error. No claim is believed: it only tells that a solver's "
            "own test ended the solve."
        )
        tables.append(time_at_accuracy_table(certified, evidence.solvers))
        pictures.append(certified_picture(certified, evidence.solvers, meshes))
    if swept:
        prose.append(
            "Every answer of the sweep is judged at the same accuracy, too, whatever "
            "tolerance was asked for; what counts there is the cheapest answer that is "
            "verified at it."
        )
        tables.append(_table(swept, evidence.solvers))
    if rest := {key: row for key, row in swept.items() if key[0] not in certified}:
        pictures.append(_picture(rest, evidence.solvers))
    return Section(
        name="accuracy", title="Time to accuracy", prose=tuple(prose),
        tables=tuple(tables), pictures=tuple(pictures),
    )  # fmt: skip


def _picture(
    swept: Mapping[Key, Mapping[str, list[Outcome]]], solvers: Sequence[str]
) -> Picture:
    drawn = dict([*swept.items()][:_PANELS])
    rest = f" The first {len(drawn)} of {len(swept)} cases." * (len(swept) > len(drawn))
    return Picture(
        name="sweep",
        caption="Certified accuracy (the largest of the four residuals) against the "
        "median total time, a line per solver through the tolerances asked for. Below "
        f"the horizontal line an answer is verified (filled).{rest}",
        figure=_figure(drawn, solvers),
    )


def _sweeps(evidence: Evidence) -> dict[Key, dict[str, list[Outcome]]]:
    """Group the outcomes of sweeps by solver, loosest tolerance first."""
    found: dict[Key, dict[str, list[Outcome]]] = {}
    for o in sorted(evidence.flat, key=lambda o: -o.tol):
        if o.first.accuracy is not None:
            row = found.setdefault((o.case, o.first.accuracy), {})
            row.setdefault(o.solver, []).append(o)
    return dict(sorted(found.items()))


def _table(
    swept: Mapping[Key, Mapping[str, list[Outcome]]], solvers: Sequence[str]
) -> Table:
    present = [s for s in solvers if any(s in row for row in swept.values())]
    rows = []
    for (case, at), row in swept.items():
        cheapest = {s: _cheapest(outcomes) for s, outcomes in row.items()}
        times = [t.value for o in cheapest.values() if o and (t := o.seconds("total"))]
        best = min(times, default=None)
        cells = [_cell(cheapest.get(s), row.get(s, ()), best) for s in present]
        rows.append((name_cell(case), Cell(text=tolerance(at), value=at), *cells))
    return Table(
        caption="Median total time of the cheapest verified answer, and the tolerance "
        "that was asked for to get it.",
        notes=(TIMED,),
        columns=("case", "accuracy", *(clean(s, 40) for s in present)),
        rows=tuple(rows),
    )


def _cheapest(outcomes: Sequence[Outcome]) -> Outcome | None:
    timed = {t.value: o for o in outcomes if o.verified and (t := o.seconds("total"))}
    return timed[min(timed)] if timed else None


def _cell(
    outcome: Outcome | None, tried: Sequence[Outcome], best: float | None
) -> Cell:
    if outcome is None:
        declined = all(o.verdict is Verdict.DECLINED for o in tried)
        text = "declined" if declined else "not reached"
        return Cell(text=text if tried else ABSENT, kind="quiet")
    interval = outcome.seconds("total")
    assert interval is not None
    return Cell(
        text=seconds(interval),
        after=f"tol {tolerance(outcome.tol)}",
        kind="best" if interval.value == best else "",
        value=interval.value,
        title=source(outcome),
    )


def _figure(
    swept: Mapping[Key, Mapping[str, list[Outcome]]], solvers: Sequence[str]
) -> Figure:
    columns = min(len(swept), 2)
    lines = -(-len(swept) // columns)
    names = [s for s in solvers if any(s in row for row in swept.values())]
    with rc_context(STYLE):
        legend = LEGEND_LINE * -(-len(names) // LEGEND_COLUMNS)
        figure = Figure(figsize=(6.9, 0.3 + legend + 2.6 * lines))
        grid = figure.subplots(lines, columns, squeeze=False).ravel()
        for axes, ((case, _), row) in zip(grid, swept.items(), strict=False):
            for solver, outcomes in row.items():
                _curve(axes, outcomes, look(solvers.index(solver)))
            allowed = next(iter(row.values()))[0].allowed
            axes.axhline(allowed, color=INK, linewidth=0.8)
            axes.set_title(legible(case))
            log_log(axes, "median total time in s", "worst residual")
        for axes in grid[len(swept) :]:
            axes.set_axis_off()
        keys = [Line2D([], [], **look(solvers.index(s))) for s in names]
        labels = [legible(s) for s in names]
        figure.legend(keys, labels, loc="outside lower center", ncols=LEGEND_COLUMNS)
    return figure


def _curve(axes: Axes, outcomes: Sequence[Outcome], style: dict[str, object]) -> None:
    """Join the answers of one solver; hollow where they are not verified."""
    points = [
        (t.value, max(o.worst, _LEAST), o.records, o.verified)
        for o in outcomes
        if o.worst is not None and (t := o.seconds("total")) is not None
    ]
    filled = [point for point in points if point[-1]]
    hollow = {**style, "markerfacecolor": "none"}
    for drawn, style_of in ((points, hollow), (filled, {**style, "linestyle": "none"})):
        if drawn:
            x, y, runs, _ = zip(*drawn, strict=True)
            (line,) = axes.plot(x, y, **style_of)  # type: ignore[arg-type]
            behind(line, runs)
