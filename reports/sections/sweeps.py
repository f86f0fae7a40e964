"""Time to accuracy: the tolerance asked for is swept, every answer is judged at one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

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
    TIMED,
    clean,
    power,
    seconds,
    tolerance,
)
from mortarbench.reports.document.layout import (
    Cell,
    Part,
    Picture,
    Table,
    name_cell,
    number,
    tolerance_cell,
)
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.figures.sweeps import certified_figure, sweep_figure
from mortarbench.reports.sections import Analysis, section
from mortarbench.reports.statistics.intervals import Interval

TEXT = Sentences(__name__)
_PANELS = 4  #: cases that are drawn; all are tabulated
ERRORS = (1e-2, 1e-4, 1e-6)  #: certified, at which times are compared
LEAST = 3  #: tolerances that make a sweep

Sweeps = Mapping[str, Mapping[str, Sequence[Outcome]]]  #: case → solver → by tolerance
Key = tuple[str, float]  #: case, and the accuracy that answers are judged at


@section(
    46, "accuracy", "Time to accuracy",
    "Time to accuracy: it takes the key accuracy in the suite, or answers with a "
    "certified error at three tolerances or more (see suites/accuracy.toml).",
)  # fmt: skip
def accuracy(a: Analysis) -> Iterator[Part]:
    """Tabulate and draw every sweep: certified errors, or else the largest residual."""
    solvers = a.evidence.solvers
    if certified := certified_sweeps(a.evidence):
        yield from TEXT.parts("certified")
        yield time_at_accuracy_table(certified, solvers)
        meshes = read_discretisation(a.evidence.directory)
        yield certified_picture(certified, solvers, meshes)
    swept: dict[Key, dict[str, list[Outcome]]] = {}
    for o in sorted(a.evidence.flat, key=lambda o: -o.tol):
        if o.first.accuracy is not None:
            row = swept.setdefault((o.case, o.first.accuracy), {})
            row.setdefault(o.solver, []).append(o)
    if swept:
        yield from TEXT.parts("swept")
        yield _table(dict(sorted(swept.items())), solvers)
    rest = [
        (case, row) for (case, _), row in sorted(swept.items()) if case not in certified
    ]
    if rest:
        caption = TEXT("sweep_caption", len(rest), _PANELS)
        figure = sweep_figure(rest[:_PANELS], solvers)
        yield Picture(name="sweep", caption=caption, figure=figure)


def _table(
    swept: Mapping[Key, Mapping[str, list[Outcome]]], solvers: Sequence[str]
) -> Table:
    present = [s for s in solvers if any(s in row for row in swept.values())]
    rows = []
    for (case, at), row in swept.items():
        cheapest = {s: _cheapest(outcomes) for s, outcomes in row.items()}
        times = [each[0] for each in cheapest.values() if each]
        best = min(times, default=None, key=lambda time: time.value)
        cells = [
            number(
                found[0], seconds, title=source(found[1]),
                after=f"tol {tolerance(found[1].tol)}",
                kind="best" if best and found[0].value == best.value else "",
            )
            if (found := cheapest.get(s))
            else _not_reached(row.get(s, ()))
            for s in present
        ]  # fmt: skip
        rows.append((name_cell(case), tolerance_cell(at), *cells))
    return Table(
        caption=TEXT("swept_caption"),
        notes=(TIMED,),
        columns=("case", "accuracy", *(clean(s, 40) for s in present)),
        rows=tuple(rows),
    )


def _cheapest(outcomes: Sequence[Outcome]) -> tuple[Interval, Outcome] | None:
    timed = [(t, o) for o in outcomes if o.verified and (t := o.seconds("total"))]
    return min(timed, key=lambda each: each[0].value, default=None)


def _not_reached(tried: Sequence[Outcome], after: str = "") -> Cell:
    if not tried:
        return Cell(kind="quiet")
    if all(o.verdict is Verdict.DECLINED for o in tried):
        return Cell(text="declined", kind="quiet")
    return Cell(text="not reached", after=after, kind="quiet")


def certified_sweeps(evidence: Evidence) -> dict[str, dict[str, list[Outcome]]]:
    """Collect the cases with certified errors at three tolerances or more."""
    found: dict[str, dict[str, list[Outcome]]] = {}
    bounded: dict[str, set[float]] = {}
    for o in sorted(evidence.flat, key=lambda o: -o.tol):
        found.setdefault(o.case, {}).setdefault(o.solver, []).append(o)
        if o.largest("energy_bound") is not None:
            bounded.setdefault(o.case, set()).add(o.tol)
    return {
        case: found[case] for case in sorted(bounded) if len(bounded[case]) >= LEAST
    }


def time_at_accuracy_table(swept: Sweeps, solvers: Sequence[str]) -> Table:
    """Tabulate the times at matched certified errors."""
    present = [s for s in solvers if any(s in row for row in swept.values())]
    rows = []
    for case, row in swept.items():
        for error in ERRORS:
            times = {s: time_at_accuracy(of, error) for s, of in row.items()}
            kinds = places({s: t for s, t in times.items() if not row[s][0].first.role})
            cells = [
                _matched(times[s], row[s], kinds.get(s, "")) if s in row else Cell()
                for s in present
            ]
            rows.append((name_cell(case), tolerance_cell(error), *cells))
    return Table(
        caption="Total time at matched certified error: relative, in the energy norm.",
        notes=(TEXT("matched_note"), TIMED),
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


def _matched(found: TimeAtAccuracy, tried: Sequence[Outcome], kind: str) -> Cell:
    reached = [o for o in tried if counts(o)]
    if found.time is None:
        closest = min((o.largest("energy_bound") or 0.0 for o in reached), default=None)
        return _not_reached(tried, f"at best {power(closest)}" if reached else "")
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
    drawn = [*swept.items()][:_PANELS]
    errors = {
        physical: mesh.error
        for physical, mesh in meshes.items()
        if mesh.kind in ("limit", "change") and mesh.error
    }
    lines = any(next(iter(row.values()))[0].physical in errors for _, row in drawn)
    return Picture(
        name="certified",
        caption=TEXT("certified_caption", len(swept), _PANELS, lines),
        figure=certified_figure(drawn, solvers, errors),
    )
