"""Time to accuracy: tolerances are swept, and answers are judged at one accuracy."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from mortarbench.harness import Verdict
from mortarbench.reports.data.cells import solver_columns, source
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.data.time_at_accuracy import (
    TimeAtAccuracy,
    counts,
    time_at_accuracy,
)
from mortarbench.reports.document.formatting import (
    TIMED,
    clean,
    power,
    seconds,
    tolerance,
)
from mortarbench.reports.document.grouping import Name, grouped
from mortarbench.reports.document.layout import Cell, Part, Picture, Table
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.figures.sweeps import certified_figure, sweep_figure
from mortarbench.reports.sections import Analysis, section
from mortarbench.reports.statistics.intervals import Interval

TEXT = Sentences(__name__)
_PANELS = 4  #: largest number of cases in a figure; all are tabulated
ERRORS = (1e-2, 1e-4, 1e-6)  #: certified errors at which times are compared
LEAST = 3  #: minimum number of tolerances in a sweep

#: outcomes by case and solver, loosest tolerance first
Sweeps = Mapping[str, Mapping[str, Sequence[Outcome]]]
Key = tuple[str, float]  #: case, and the accuracy at which answers are judged


@section(
    46,
    "accuracy",
    "Time to accuracy",
    "Time to accuracy: requires the key accuracy in the suite, or answers with a "
    "certified error at three or more tolerances (see suites/accuracy.toml).",
)
def accuracy(a: Analysis) -> Iterator[Part]:
    """Tabulate all sweeps; draw the first ones, by certified errors or by residuals.

    Only the sweeps of cases without enough certified errors are drawn by residuals.
    """
    solvers = a.evidence.solvers
    if certified := certified_sweeps(a.evidence):
        yield from TEXT.parts("certified")
        yield time_at_accuracy_table(certified, solvers)
        yield certified_picture(certified, solvers)
    judged = [o for o in a.evidence.flat if o.first.accuracy is not None]
    swept = by_solver(judged, lambda o: (o.case, o.first.judged_at))
    swept = dict(sorted(swept.items()))
    if swept:
        yield from TEXT.parts("swept")
        yield _table(swept, solvers)
    rest = [(case, row) for (case, _), row in swept.items() if case not in certified]
    if rest:
        caption = TEXT("sweep_caption", len(rest), _PANELS)
        figure = sweep_figure(rest[:_PANELS], solvers)
        yield Picture(name="sweep", caption=caption, figure=figure)


def _table(
    swept: Mapping[Key, Mapping[str, list[Outcome]]], solvers: Sequence[str]
) -> Table:
    cheapest = {key: _cheapest_of(row) for key, row in swept.items()}
    best = {
        key: min((time.value for time, _ in of.values()), default=0.0)
        for key, of in cheapest.items()
    }

    def cell(solver: str, key: Key) -> Cell:
        if solver not in cheapest[key]:
            return _not_reached(swept[key].get(solver, ()))
        time, outcome = cheapest[key][solver]
        return Cell.time(
            time,
            title=source(outcome),
            after=f"tol {tolerance(outcome.tol)}",
            kind="best" if time.value == best[key] else "",
        )

    return Table.of(
        TEXT("swept_caption"),
        swept,
        (
            ("case", lambda key: Cell.name(key[0])),
            ("accuracy", lambda key: Cell.tolerance(key[1])),
            *solver_columns(_present(swept, solvers), cell),
        ),
        notes=(TIMED,),
    )


def _present(
    rows: Mapping[Any, Mapping[str, object]], solvers: Sequence[str]
) -> list[str]:
    return [s for s in solvers if any(s in row for row in rows.values())]


def _cheapest_of(
    row: Mapping[str, Sequence[Outcome]],
) -> dict[str, tuple[Interval, Outcome]]:
    """Select the fastest verified answer of each solver that has one."""
    timed = {
        s: [(t, o) for o in of if o.verified and (t := o.seconds("total"))]
        for s, of in row.items()
    }
    return {s: min(of, key=lambda each: each[0].value) for s, of in timed.items() if of}


def _not_reached(tried: Sequence[Outcome], after: str = "") -> Cell:
    if not tried:
        return Cell(kind="quiet")
    if all(o.verdict is Verdict.DECLINED for o in tried):
        return Cell(text="declined", kind="quiet")
    return Cell(text="not reached", after=after, kind="quiet")


def certified_sweeps(evidence: Evidence) -> dict[str, dict[str, list[Outcome]]]:
    """Collect the cases with certified errors at three or more tolerances."""
    bounded = (o for o in evidence.flat if o.largest("energy_bound") is not None)
    tols = Counter(case for case, _ in {(o.case, o.tol) for o in bounded})
    swept = (o for o in evidence.flat if tols[o.case] >= LEAST)
    return dict(sorted(by_solver(swept, lambda o: o.case).items()))


def by_solver(
    outcomes: Iterable[Outcome], name: Callable[[Outcome], Name]
) -> dict[Name, dict[str, list[Outcome]]]:
    """Group outcomes by a name and by solver, loosest tolerance first."""
    ordered = sorted(outcomes, key=lambda o: -o.tol)
    groups = grouped(ordered, name).items()
    return {key: grouped(of, lambda o: o.solver) for key, of in groups}


def time_at_accuracy_table(swept: Sweeps, solvers: Sequence[str]) -> Table:
    """Tabulate the times at equal certified errors."""
    times = {
        (case, error): {s: time_at_accuracy(of, error) for s, of in row.items()}
        for case, row in swept.items()
        for error in ERRORS
    }
    kinds = {
        (case, error): places(
            {s: t for s, t in of.items() if not swept[case][s][0].first.arm}
        )
        for (case, error), of in times.items()
    }

    def cell(solver: str, key: Key) -> Cell:
        if solver not in times[key]:
            return Cell()
        kind = kinds[key].get(solver, "")
        return _matched(times[key][solver], swept[key[0]][solver], kind)

    return Table.of(
        "Total time at equal certified relative error in the energy norm.",
        times,
        (
            ("case", lambda key: Cell.name(key[0])),
            ("error", lambda key: Cell.tolerance(key[1])),
            *solver_columns(_present(swept, solvers), cell),
        ),
        notes=(TEXT("matched_note"), TIMED),
    )


def places(found: Mapping[str, TimeAtAccuracy]) -> dict[str, str]:
    """Return "best", "tied" or "" for each solver of a row with an interpolated time.

    A time that is only bounded from above gets no entry. Because the true time may be
    the smallest of the row, no other time of the row is then marked as the best.
    """
    known = {s: m.time for s, m in found.items() if m.kind == "between" and m.time}
    if not known:
        return {}
    fastest = min(known.values(), key=lambda t: t.value)
    best = "" if any(m.kind == "looser" for m in found.values()) else "best"
    return {
        s: best
        if t.value == fastest.value
        else "tied"
        if t.low <= fastest.high and t.samples > 1
        else ""
        for s, t in known.items()
    }


def _matched(found: TimeAtAccuracy, tried: Sequence[Outcome], kind: str) -> Cell:
    reached = [o for o in tried if counts(o)]
    if found.time is None:
        closest = min((o.largest("energy_bound") or 0.0 for o in reached), default=None)
        return _not_reached(
            tried, f"smallest error {power(closest)}" if reached else ""
        )
    runs = " ".join(i for o in reached for i in o.run_ids)
    looser = found.kind == "looser"
    return Cell(
        text=("≤ " if looser else "") + seconds(found.time),
        after="more accurate at the loosest tolerance" if looser else "",
        symbol="≈" if kind == "tied" else "",
        kind=kind,
        value=found.time.value,
        title=clean(f"from runs {runs}", 400),
    )


def certified_picture(swept: Sweeps, solvers: Sequence[str]) -> Picture:
    """Draw certified error against time for the first few cases."""
    return Picture(
        name="certified",
        caption=TEXT("certified_caption", len(swept), _PANELS),
        figure=certified_figure([*swept.items()][:_PANELS], solvers),
    )
