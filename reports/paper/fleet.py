"""SMALBE and other solvers: primal and dual forms, and time to certified accuracy."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from mortarbench.harness import Verdict
from mortarbench.reports.data.cells import source, verdict_cell
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.document.figure import (
    INK,
    Axis,
    Figure,
    Key,
    Look,
    Panel,
    Row,
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
    curve,
    legible,
    log,
    look,
    solver_keys,
    with_legend,
)
from mortarbench.reports.paper.timings import titled
from mortarbench.reports.statistics.intervals import Interval, power_law

DUALS = ("dual", "dual-bounds")
TARGETS = (1e-2, 1e-4, 1e-6)  #: certified relative errors in the energy norm
COLUMNS = 5  #: number of columns of a legend
_FAILED = Look(colour=INK, marker="x", dash=None)


class Place(NamedTuple):
    """Answer of a solver with the size of its problem."""

    size: int
    outcome: Outcome
    dofs: bool  #: True if the size is n (dofs), False if it is m (size of the dual)

    @property
    def time(self) -> Interval | None:
        """Median time, including any dualisation if the size is n (dofs)."""
        dualised = self.outcome.with_dualising if self.dofs else None
        return dualised or self.outcome.seconds("total")

    @property
    def tried(self) -> bool:
        """True unless the solver declined the problem."""
        return self.outcome.verdict is not Verdict.DECLINED

    @property
    def failed(self) -> bool:
        """True if the solver tried the problem and its answer is not verified."""
        return self.tried and not self.outcome.verified


def places(evidence: Evidence, form: str, *, dofs: bool) -> dict[str, list[Place]]:
    """Return the answers of each solver in one form, in order of n (dofs) or m.

    m is the number of variables of the QP. A size missing in one answer is taken from
    other answers to the same case.
    """
    answers: dict[str, list[Place]] = {s: [] for s in evidence.solvers}
    for row in evidence.outcomes.values():
        for solver, outcome in row.items():
            if outcome.first.form == form:
                sizes = (
                    o.size("dofs") if dofs else o.first.sizes.get("variables")
                    for o in (outcome, *row.values())
                )
                size = int(next(filter(None, sizes), 0))
                answers[solver].append(Place(size, outcome, dofs))
    by_size = {s: sorted(of, key=lambda p: p.size) for s, of in answers.items()}
    return {s: of for s, of in by_size.items() if of}


def fleet_figure(evidence: Evidence) -> Figure:
    """Plot the times of the solvers on both duals against m."""
    titles = {
        "dual": "dual: Dirichlet rows as equalities",
        "dual-bounds": "dual-bounds: bounds only",
    }
    return _figure(evidence, titles, "size of the dual $m$", dofs=False)


def primal_dual_figure(evidence: Evidence) -> Figure:
    """Plot total times of primal and dual forms, with dualisation, against n."""
    titles = {"primal": "primal", "dual": "dual, dualisation included"}
    return _figure(evidence, titles, "degrees of freedom $n$", dofs=True)


def _figure(
    evidence: Evidence, titles: dict[str, str], size: str, *, dofs: bool
) -> Figure:
    """Plot times in a panel for each form, above a strip that marks failures."""
    found = {form: places(evidence, form, dofs=dofs) for form in titles}
    every = {
        s: [p for f in found.values() for p in f.get(s, ())] for s in evidence.solvers
    }
    drawn = [s for s, of in every.items() if any(p.tried for p in of)]
    failing = [s for s in drawn if any(p.failed for p in every[s])]
    looks = {s: look(i) for i, s in enumerate(evidence.solvers)}
    above, strips = list[tuple[str, Panel]](), []
    for form, title in titles.items():
        first = not above
        axis = Axis(label=size, log=True, shared=size if dofs else form)
        top = replace(axis, label="", numbered=False, marked=False)
        marks = [
            mark
            for solver, mine in found[form].items()
            for mark in curve(
                ((p.size, p.time, p.outcome) for p in mine if p.outcome.verified),
                looks[solver],
                solver,
            )
        ]
        above.append(
            (
                title,
                Panel(
                    x=top if failing else axis,
                    marks=tuple(marks),
                    y=Axis(
                        label="time in s" * first,
                        log=True,
                        shared="time",
                        numbered=first,
                    ),
                ),
            )
        )
        crosses = [
            mark
            for row, solver in enumerate(failing)
            for mark in curve(
                (
                    (p.size, -float(row), p.outcome)
                    for p in found[form].get(solver, ())
                    if p.failed
                ),
                replace(_FAILED, colour=looks[solver].colour, size=5, edge=1.2),
                solver,
            )
        ]
        names = categories([legible(s) for s in failing], line=False, numbered=first)
        strips.append(Panel(x=axis, y=names, marks=tuple(crosses), grid="none"))
    height = 0.17 * len(failing) + 0.04
    keys = list(solver_keys(drawn, evidence.solvers))
    rows = [Row(panels=titled(*above), height=2.6)]
    if failing:
        rows.append(Row(panels=tuple(strips), height=height))
        keys.append(Key(label="not verified", look=_FAILED))
    return with_legend(rows, keys, COLUMNS, 2.9 + height)


def fleet_table(evidence: Evidence, form: str) -> Table:
    """Tabulate times or verdicts by m, and fitted exponents."""
    found = {
        solver: mine
        for solver, mine in places(evidence, form, dofs=False).items()
        if any(p.tried for p in mine)
    }
    sizes = sorted({p.size for mine in found.values() for p in mine})
    rows = []
    for solver, mine in found.items():
        at = {p.size: p.outcome for p in mine}
        timed = [
            (p.size, t.value)
            for p in mine
            if p.outcome.verified and (t := p.time) is not None
        ]
        power = Cell(title="fewer than three verified sizes")
        if len({size for size, _ in timed}) >= 3:
            law = power_law(*zip(*timed, strict=True))
            power = Cell(text=exponent(law), value=law.exponent)
        cells = [
            _time(o, o.seconds("total")) if (o := at.get(m)) else Cell() for m in sizes
        ]
        rows.append((Cell(text=clean(solver, 40)), *cells, power))
    return Table(
        caption=f"Form {form}: median time by the size m of the dual, and the exponent "
        "p of t = c·mᵖ fitted to the verified sizes.",
        notes=(TIMED,),
        columns=("", *(f"m = {m}" for m in sizes), "p [95 %]"),
        rows=tuple(rows),
    )


def _time(outcome: Outcome, time: Interval | None) -> Cell:
    """Return the time of a verified answer, or else its verdict."""
    if not outcome.verified:
        return verdict_cell(outcome)
    value = time.value if time else None
    return Cell(text=seconds(time), value=value, title=source(outcome))


def totals_table(evidence: Evidence) -> Table:
    """Tabulate primal and dual total times at the largest n common to both."""
    primal, dual = (places(evidence, form, dofs=True) for form in ("primal", "dual"))
    tried = [{p.size for m in f.values() for p in m} for f in (primal, dual)]
    n = max(set.intersection(*tried), default=0)
    rows = []
    for solver in evidence.solvers:
        of_primal, of_dual = (
            next((p for p in f.get(solver, ()) if p.size == n), None)
            for f in (primal, dual)
        )
        dualising = of_dual.outcome.dualising if of_dual else None
        cells = (
            _time(of_primal.outcome, of_primal.time) if of_primal else Cell(),
            _time(o := of_dual.outcome, o.seconds("total")) if of_dual else Cell(),
            Cell(text=seconds(dualising), value=dualising.value if dualising else None),
            _time(of_dual.outcome, of_dual.time) if of_dual else Cell(),
        )
        rows.append((Cell(text=clean(solver, 40)), *cells))
    return Table(
        caption=f"Total times at n = {n}, prepare and solve. The dualisation of one "
        "load step, including the factorisation, is measured once for all "
        "solvers, so the intervals in the last column contain only the "
        "scatter of the solver times.",
        columns=("", "primal", "dual", "dualising", "dual with dualising"),
        rows=tuple(rows),
    )


def certified_figure(evidence: Evidence) -> Figure:
    """Plot certified errors against times, a curve over tolerances for each solver."""
    panels = list[tuple[str, Panel]]()
    for form in (f for f in DUALS if places(evidence, f, dofs=True)):
        marks = [
            mark
            for solver, answers in swept(evidence, form).items()
            for mark in curve(
                ((time.value, error, o) for o, time, error in answers),
                look(evidence.solvers.index(solver)),
                solver,
            )
        ]
        label = "certified relative error, energy norm" * (not panels)
        error = replace(log(label), shared="error", numbered=not panels)
        panel = Panel(x=log("median time in s"), y=error, marks=tuple(marks))
        panels.append((form, panel))
    keys = solver_keys(evidence.solvers, evidence.solvers)
    return with_legend((Row(panels=titled(*panels)),), keys, COLUMNS, 2.9)


def swept(
    evidence: Evidence, form: str
) -> dict[str, list[tuple[Outcome, Interval, float]]]:
    """Return verified answers, times and certified errors by solver, loosest first."""
    answers: dict[str, list[tuple[Outcome, Interval, float]]] = {}
    for o in sorted(evidence.flat, key=lambda o: -o.tol):
        time, error = o.seconds("total"), o.largest("energy_bound")
        if o.first.form == form and o.verified and time and error:
            answers.setdefault(o.solver, []).append((o, time, error))
    return answers


def certified_table(evidence: Evidence) -> Table:
    """Tabulate the smallest time to a certified error, and its tolerance."""
    rows = []
    for form in DUALS:
        for solver, answers in swept(evidence, form).items():
            cells = [Cell(text=form), Cell(text=clean(solver, 40))]
            for target in TARGETS:
                good = [answer for answer in answers if answer[-1] <= target]
                if not good:
                    cells.append(Cell(text="not reached", kind="quiet"))
                    continue
                o, time, error = min(good, key=lambda answer: answer[1].value)
                cells.append(
                    Cell(
                        text=seconds(time),
                        after=f"tol {tolerance(o.tol)}",
                        value=time.value,
                        title=f"{source(o)}, certified {significant(error)}",
                    )
                )
            rows.append(tuple(cells))
    return Table(
        caption="Smallest median time to a certified relative error in the energy "
        "norm, and the tolerance of this solve.",
        notes=(TIMED,),
        columns=("form", "solver", *(f"error ≤ {tolerance(t)}" for t in TARGETS)),
        rows=tuple(rows),
        text_columns=2,
    )
