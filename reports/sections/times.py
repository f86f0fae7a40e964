"""Times of verified answers, each with its uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from reports.data.evidence import Evidence, Outcome
from reports.document.formatting import ABSENT, TIMED, VERDICTS, clean, seconds
from reports.document.layout import Cell, Section, Table
from reports.sections.cells import case_cells, grid, source
from reports.statistics.intervals import COVERAGE, Interval


def times(evidence: Evidence) -> Section:
    """Compare the total times of verified answers."""
    intervals = [o.seconds("total") for o in evidence.flat]
    return Section(
        name="times",
        title="Times",
        prose=(
            "Median of prepare + solve over the repeats, each prepared afresh, and in "
            "brackets an interval for the median.",
            _coverage(intervals),
            "Bold: the fastest verified answer of its row; ≈: verified, and its "
            "interval overlaps that of the fastest, so that this run does not tell "
            f"them apart.{_weakness(intervals)} Struck out: the answer was not "
            "verified, so its time is no result.",
        ),
        tables=(
            grid(evidence, f"Total time, median and interval. {TIMED}", _time),
            *_dualised(evidence),
        ),
    )


def _dualised(evidence: Evidence) -> list[Table]:
    """Charge dualising to dual forms, where it was measured; primal forms have none."""
    charged = [
        row
        for row in evidence.outcomes.values()
        if any(o.with_dualising is not None and o.verified for o in row.values())
    ]
    if not charged:
        return []
    return [
        Table(
            caption="Dual forms with dualising (factor of K, F and d): its own time, "
            "and the totals above plus that, verified answers only. These are to be "
            "compared with the primal forms. Dualising is measured once for each "
            "build of a case; the intervals are those of the solver.",
            columns=(
                "case", "tol", "dualising", *(clean(s, 40) for s in evidence.solvers),
            ),
            rows=tuple(_charged(row, evidence.solvers) for row in charged),
        )
    ]  # fmt: skip


def _charged(row: Mapping[str, Outcome], solvers: Sequence[str]) -> tuple[Cell, ...]:
    """Make one row of the table of totals with dualising."""
    charged = next(o for o in row.values() if o.dualising is not None)
    own = charged.dualising
    assert own is not None
    totals = {s: o.with_dualising for s, o in row.items() if o.verified}
    ranked = [t for s, t in totals.items() if t is not None and not row[s].first.arm]
    best = min((t.value for t in ranked), default=None)
    cells = []
    for solver in solvers:
        total = totals.get(solver)
        if total is None:
            cells.append(Cell(text=ABSENT, kind="quiet"))
            continue
        kind = "best" if total.value == best else ""
        title = source(row[solver])
        cells.append(
            Cell(text=seconds(total), kind=kind, value=total.value, title=title)
        )
    dualising = Cell(text=seconds(own), value=own.value, title=source(charged))
    return (*case_cells(row), dualising, *cells)


def _coverage(intervals: list[Interval | None]) -> str:
    """State what the brackets mean for each number of repeats that occurs."""
    known = {i.samples: i.coverage for i in intervals if i is not None}
    stated = ", ".join(
        f"{coverage:.3g} for {n} repeats"
        for n, coverage in sorted(known.items())
        if n > 1
    )
    if not stated:
        return "A single run says nothing of its uncertainty."
    return (
        "The interval runs between order statistics (below six repeats: the smallest "
        "and the largest) and holds the true median, whatever the distribution, with "
        f"probability {stated}; this presumes repeats that are independent and "
        "identically distributed, which those on a busy machine are not."
    )


def _weakness(intervals: list[Interval | None]) -> str:
    """Say how little an order of times means where an interval covers too rarely."""
    known = [i for i in intervals if i is not None and i.samples > 1]
    weakest = min(known, key=lambda i: i.coverage, default=None)
    if weakest is None or weakest.coverage >= COVERAGE:
        return ""
    return (
        f" That is a weak test: with {weakest.samples} repeats an interval misses the "
        f"true median once in {1 / (1 - weakest.coverage):.0f} (it covers with "
        f"{100 * weakest.coverage:.3g} %), so an order that rests on it may be chance."
    )


def _time(outcome: Outcome, row: Mapping[str, Outcome]) -> Cell:
    interval = outcome.seconds("total")
    if interval is None or not outcome.verified:
        symbol, words = VERDICTS[outcome.verdict]
        if interval is None:
            return Cell(text=words, symbol=symbol, kind="quiet", title=source(outcome))
        return Cell(
            text=seconds(interval), after=words, kind="void", title=source(outcome)
        )
    kind = "" if outcome.first.arm else _rank(interval, row)
    return Cell(
        text=seconds(interval),
        symbol="≈" if kind == "tied" else "",
        kind=kind,
        title=source(outcome),
        value=interval.value,
    )


def _rank(interval: Interval, row: Mapping[str, Outcome]) -> str:
    """Rank among the verified answers of a row; null arms do not compete."""
    rivals = [
        o.seconds("total") for o in row.values() if o.verified and not o.first.arm
    ]
    fastest = min((i for i in rivals if i is not None), key=lambda i: i.value)
    overlaps = interval.low <= fastest.high and interval.samples > 1
    return "best" if interval == fastest else "tied" if overlaps else ""
