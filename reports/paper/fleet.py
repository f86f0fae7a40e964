"""SMALBE against the fleet, primal against dual, and time to certified accuracy."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

from mortarbench.harness import Verdict
from mortarbench.reports.data.cells import legend, source, verdict_cell
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.document.figure import (
    INK,
    Axis,
    Figure,
    Intervals,
    Key,
    Look,
    Panel,
    Row,
    Series,
    categories,
)
from mortarbench.reports.document.formatting import (
    TIMED,
    clean,
    exponent,
    seconds,
    significant,
    tolerance,
)
from mortarbench.reports.document.layout import Cell, Table
from mortarbench.reports.figures.style import (
    LEGEND_LINE,
    below,
    legible,
    log,
    look,
    run_ids,
    solver_keys,
)
from mortarbench.reports.statistics.intervals import Interval, power_law

DUALS = ("dual", "dual-bounds")
TARGETS = (1e-2, 1e-4, 1e-6)  #: certified relative errors in the energy norm
COLUMNS = 5  #: of a legend


class Place(NamedTuple):
    """One answer at its size."""

    size: int
    outcome: Outcome

    @property
    def time(self) -> Interval | None:
        """Median time, that of dualising included where there is any."""
        return self.outcome.with_dualising or self.outcome.seconds("total")


def _size(outcome: Outcome, row: Iterable[Outcome], *, dofs: bool) -> int:
    """Find n or the variables of the QP, which any answer to the same case tells."""
    for one in (outcome, *row):
        found = one.size("dofs") if dofs else one.first.sizes.get("variables")
        if found:
            return int(found)
    return 0


def places(evidence: Evidence, form: str, *, dofs: bool) -> dict[str, list[Place]]:
    """Solver → its answers in one form, verified or not, by n (dofs) or m."""
    found: dict[str, list[Place]] = {s: [] for s in evidence.solvers}
    for row in evidence.outcomes.values():
        for solver, outcome in row.items():
            if outcome.first.form == form:
                size = _size(outcome, row.values(), dofs=dofs)
                found[solver].append(Place(size, outcome))
    return {s: sorted(mine, key=lambda p: p.size) for s, mine in found.items() if mine}


def fleet_figure(evidence: Evidence) -> Figure:
    """Draw the solvers' times on both duals against m."""
    titles = {
        "dual": "dual: Dirichlet rows as equalities",
        "dual-bounds": "dual-bounds: bounds alone",
    }
    return _figure(evidence, titles, "size of the dual $m$", dofs=False)


def primal_dual_figure(evidence: Evidence) -> Figure:
    """Draw primal totals and dual totals with dualisation against n."""
    titles = {
        "primal": "primal",
        "dual": "dual, dualisation included",
    }
    return _figure(evidence, titles, "degrees of freedom $n$", dofs=True)


def _figure(
    evidence: Evidence, titles: dict[str, str], size: str, *, dofs: bool
) -> Figure:
    """Draw a panel for each form; below, a strip of what was not verified."""
    found = {form: places(evidence, form, dofs=dofs) for form in titles}
    drawn = [
        s for s in evidence.solvers if any(_tried(f.get(s)) for f in found.values())
    ]
    failing = [s for s in drawn if any(_failed(f.get(s, ())) for f in found.values())]
    above, strips = [], []
    for i, (form, title) in enumerate(titles.items()):
        axis = Axis(label=size, log=True, shared=size if dofs else form)
        marks = [
            _curve(mine, look(evidence.solvers.index(solver)), dofs=dofs)
            for solver, mine in found[form].items()
        ]
        top = replace(axis, label="", numbered=False, marked=False)
        times = Axis(label="time in s", log=True, shared="time")
        above.append(
            Panel(
                x=top if failing else axis,
                y=times if i == 0 else replace(times, label="", numbered=False),
                marks=tuple(mark for mark in marks if mark is not None),
                title=f"({'abc'[i]}) {title}",
            )
        )
        names = categories([legible(s) for s in failing], line=False, numbered=i == 0)
        crosses = _crosses(found[form], failing, evidence)
        strips.append(Panel(x=axis, y=names, marks=crosses, grid="none"))
    height = 0.17 * len(failing) + 0.04
    keys = list(solver_keys(drawn, evidence.solvers))
    rows = [Row(panels=tuple(above), height=2.6)]
    if failing:
        rows.append(Row(panels=tuple(strips), height=height))
        keys.append(
            Key(label="not verified", look=Look(colour=INK, marker="x", dash=None))
        )
    lines = -(-len(keys) // COLUMNS)
    return Figure(
        rows=tuple(rows),
        height=2.9 + height + LEGEND_LINE * lines,
        legend=below(keys, COLUMNS),
    )


def _tried(mine: Sequence[Place] | None) -> bool:
    """Whether a solver takes such problems at all."""
    return any(p.outcome.verdict is not Verdict.DECLINED for p in mine or ())


def _failed(mine: Sequence[Place]) -> list[Place]:
    """Keep what was tried and not verified: no time of it means anything."""
    kept = (p for p in mine if p.outcome.verdict is not Verdict.DECLINED)
    return [p for p in kept if not p.outcome.verified]


def _curve(mine: Sequence[Place], style: Look, *, dofs: bool) -> Series | None:
    """Make the medians of verified answers with their intervals."""
    points = []
    for place in mine:
        time = place.time if dofs else place.outcome.seconds("total")
        if place.outcome.verified and time is not None:
            points.append((float(place.size), time, run_ids(place.outcome.records)))
    if not points:
        return None
    sizes, times, runs = zip(*points, strict=True)
    low, high = tuple(t.low for t in times), tuple(t.high for t in times)
    return Series(
        x=sizes, y=tuple(t.value for t in times), look=style, runs=runs,
        intervals=Intervals(low=low, high=high), solver=mine[0].outcome.solver,
    )  # fmt: skip


def _crosses(
    found: dict[str, list[Place]], failing: Sequence[str], evidence: Evidence
) -> tuple[Series, ...]:
    """Put a cross where an answer was tried for and not verified, a row per solver."""
    made = []
    for row, solver in enumerate(failing):
        colour = look(evidence.solvers.index(solver)).colour
        if failed := _failed(found.get(solver, ())):
            made.append(
                Series(
                    x=tuple(float(p.size) for p in failed),
                    y=(-float(row),) * len(failed),
                    look=Look(colour=colour, marker="x", dash=None, size=5, edge=1.2),
                    solver=solver,
                    runs=tuple(run_ids(p.outcome.records) for p in failed),
                )
            )
    return tuple(made)


def fleet_table(evidence: Evidence, form: str) -> Table:
    """Tabulate the times by m, and the exponents; failures as what they are."""
    found = {s: m for s, m in places(evidence, form, dofs=False).items() if _tried(m)}
    sizes = sorted({p.size for mine in found.values() for p in mine})
    rows = []
    for solver, mine in found.items():
        at = {p.size: p.outcome for p in mine}
        cells = [_time(at.get(m)) for m in sizes]
        rows.append((Cell(text=clean(solver, 40)), *cells, _exponent(mine)))
    return Table(
        caption=f"Form {form}: median time by the size m of the dual, and the exponent "
        "p of t = c·mᵖ over the verified sizes.",
        notes=(TIMED, *legend(rows)),
        columns=("", *(f"m = {m}" for m in sizes), "p [95 %]"),
        rows=tuple(rows),
    )


def _time(outcome: Outcome | None) -> Cell:
    if outcome is None:
        return Cell()
    if not outcome.verified:
        return verdict_cell(outcome)
    interval = outcome.seconds("total")
    value = interval.value if interval else None
    return Cell(text=seconds(interval), value=value, title=source(outcome))


def _exponent(mine: Sequence[Place]) -> Cell:
    timed = [
        (p.size, t.value) for p in mine
        if p.outcome.verified and (t := p.outcome.seconds("total")) is not None
    ]  # fmt: skip
    if len({size for size, _ in timed}) < 3:
        return Cell(title="fewer than three verified sizes")
    law = power_law(*zip(*timed, strict=True))
    return Cell(text=exponent(law), value=law.exponent)


def totals_table(evidence: Evidence) -> Table:
    """Tabulate primal and dual at the largest n that both were tried at."""
    primal, dual = (places(evidence, form, dofs=True) for form in ("primal", "dual"))
    tried = [{p.size for m in f.values() for p in m} for f in (primal, dual)]
    n = max(set.intersection(*tried), default=0)
    rows = []
    for solver in evidence.solvers:
        (of_primal,), (of_dual,) = (
            [next((p for p in f.get(solver, ()) if p.size == n), None)]
            for f in (primal, dual)
        )
        dualising = of_dual.outcome.dualising if of_dual else None
        cells = (
            _total(of_primal),
            _time(of_dual.outcome if of_dual else None),
            Cell(text=seconds(dualising), value=dualising.value if dualising else None),
            _total(of_dual),
        )
        rows.append((Cell(text=clean(solver, 40)), *cells))
    return Table(
        caption=f"Totals at n = {n}, prepare and solve. Dualising one load step, "
        "factorisation included, is measured once for all solvers, so that the "
        "interval of the last column is that of the solver alone.",
        columns=("", "primal", "dual", "dualising", "dual with dualising"),
        rows=tuple(rows),
    )


def _total(place: Place | None) -> Cell:
    if place is None or not place.outcome.verified:
        return _time(place.outcome if place else None)
    time = place.time
    value = time.value if time else None
    return Cell(text=seconds(time), value=value, title=source(place.outcome))


def certified_figure(evidence: Evidence) -> Figure:
    """Draw certified errors against times, a line through the tolerances."""
    forms = [f for f in DUALS if places(evidence, f, dofs=True)]
    panels = []
    for i, form in enumerate(forms):
        marks = []
        for solver, answers in swept(evidence, form).items():
            outcomes, times, errors = zip(*answers, strict=True)
            marks.append(
                Series(
                    x=tuple(t.value for t in times), y=errors, solver=solver,
                    look=look(evidence.solvers.index(solver)),
                    runs=tuple(run_ids(o.records) for o in outcomes),
                )
            )  # fmt: skip
        error = replace(log("certified relative error, energy norm"), shared="error")
        panels.append(
            Panel(
                x=log("median time in s"),
                y=error if i == 0 else replace(error, label="", numbered=False),
                marks=tuple(marks),
                title=f"({'ab'[i]}) {form}",
            )
        )
    keys = solver_keys(evidence.solvers, evidence.solvers)
    return Figure(
        rows=(Row(panels=tuple(panels)),),
        height=2.9 + LEGEND_LINE * -(-len(keys) // COLUMNS),
        legend=below(keys, COLUMNS),
    )


def swept(
    evidence: Evidence, form: str
) -> dict[str, list[tuple[Outcome, Interval, float]]]:
    """Solver → verified answers with time and certified error, loosest first."""
    found: dict[str, list[tuple[Outcome, Interval, float]]] = {}
    for o in sorted(evidence.flat, key=lambda o: -o.tol):
        time, error = o.seconds("total"), o.largest("energy_bound")
        if o.first.form == form and o.verified and time and error:
            found.setdefault(o.solver, []).append((o, time, error))
    return found


def certified_table(evidence: Evidence) -> Table:
    """Tabulate the least time in which an error was certified, and at what tol."""
    rows = []
    for form in DUALS:
        for solver, answers in swept(evidence, form).items():
            cells = [_cheapest(answers, target) for target in TARGETS]
            rows.append((Cell(text=form), Cell(text=clean(solver, 40)), *cells))
    return Table(
        caption="Least median time in which the relative error in the energy norm was "
        "certified, and the tolerance asked for to get there.",
        notes=(TIMED,),
        columns=("form", "solver", *(f"error ≤ {tolerance(t)}" for t in TARGETS)),
        rows=tuple(rows),
        text_columns=2,
    )


def _cheapest(
    answers: Sequence[tuple[Outcome, Interval, float]], target: float
) -> Cell:
    good = [(t.value, o, t, e) for o, t, e in answers if e <= target]
    if not good:
        return Cell(text="not reached", kind="quiet")
    value, outcome, time, error = min(good, key=lambda g: g[0])
    return Cell(
        text=seconds(time), after=f"tol {tolerance(outcome.tol)}", value=value,
        title=f"{source(outcome)}, certified {significant(error)}",
    )  # fmt: skip
