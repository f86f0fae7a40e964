"""Time to accuracy: the tolerance asked for is swept, every answer is judged at one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mortarbench.harness import Verdict
from mortarbench.harness.crossval.discretisation import (
    Discretisation,
    read_discretisation,
)
from mortarbench.reports.data.cells import source
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.data.time_at_accuracy import (
    TimeAtAccuracy,
    counts,
    time_at_accuracy,
)
from mortarbench.reports.document.formatting import (
    ABSENT,
    TIMED,
    clean,
    power,
    seconds,
    tolerance,
)
from mortarbench.reports.document.layout import Cell, Picture, Section, Table, name_cell
from mortarbench.reports.figures.sweeps import certified_figure, sweep_figure
from mortarbench.reports.statistics.intervals import COVERAGE

_PANELS = 4  #: cases that are drawn; all are tabulated

ERRORS = (1e-2, 1e-4, 1e-6)  #: certified, at which times are compared
LEAST = 3  #: tolerances that make a sweep

Sweeps = Mapping[str, Mapping[str, Sequence[Outcome]]]  #: case → solver → by tolerance
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
        figure=sweep_figure([(case, row) for (case, _), row in drawn.items()], solvers),
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
            kinds = places({s: m for s, m in found.items() if not row[s][0].first.role})
            cells = [
                _matched(found.get(s), row.get(s, ()), kinds.get(s, ""))
                for s in present
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


def _matched(found: TimeAtAccuracy | None, tried: Sequence[Outcome], kind: str) -> Cell:
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
    errors = {
        physical: mesh.error
        for physical, mesh in meshes.items()
        if mesh.kind in ("limit", "change") and mesh.error
    }
    lines = (
        " Below a tenth of the discretisation error, more digits say no more about the "
        "bodies; where refinement has no limit, it is the change to the next mesh."
    ) * any(_physical(row) in errors for row in drawn.values())
    return Picture(
        name="certified",
        caption="Certified relative error in the energy norm against the median total "
        "time, a line per solver through the tolerances asked for. Bars: interval of "
        "the median. Filled: the solver's own test ended the solve; hollow: a limit "
        f"did, or it gave up.{lines}{rest}",
        figure=certified_figure([*drawn.items()], solvers, errors),
    )


def _physical(row: Mapping[str, Sequence[Outcome]]) -> str:
    return next(iter(row.values()))[0].physical
