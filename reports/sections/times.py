"""Times of verified answers, their ratios, and how well they are known.

What equal solvers differ by needs a null arm, and how the machine ran a canary in the
records; journals from before have neither.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median

import numpy as np

from mortarbench.harness import Record
from mortarbench.harness.running.pairs import Ratio, paired_ratio, ratio_of
from mortarbench.harness.suite.suite import NULL
from mortarbench.reports.data.cells import case_cells, grid, source
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.document.formatting import (
    ABSENT,
    TIMED,
    VERDICTS,
    bracketed,
    clean,
    plural,
    seconds,
)
from mortarbench.reports.document.layout import Cell, Section, Table, name_cell
from mortarbench.reports.statistics.intervals import COVERAGE, Interval, median_interval

_UNPAIRED = (
    "Unpaired: the two were not measured in the same blocks, since one was added to "
    "the suite later, say. Their times are compared as two samples, by Welch's "
    "interval; what changed on the machine from one session to the other is not in it."
)
_PARTS = 3  #: the canary's drift compares the last third with the first


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
    ranked = [t for s, t in totals.items() if t is not None and not row[s].first.role]
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
    kind = "" if outcome.first.role else _rank(interval, row)
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
        o.seconds("total") for o in row.values() if o.verified and not o.first.role
    ]
    fastest = min((i for i in rivals if i is not None), key=lambda i: i.value)
    overlaps = interval.low <= fastest.high and interval.samples > 1
    return "best" if interval == fastest else "tied" if overlaps else ""


def ratios(evidence: Evidence) -> Section | None:
    """Tabulate ratios to the fastest verified answer; None without repeats."""
    if not any(len(o.records) > 1 for o in evidence.flat):
        return None
    fastest = {key: _fastest(row) for key, row in evidence.outcomes.items()}
    apart = any(
        not (o.by_block.keys() & best.by_block.keys())
        for key, row in evidence.outcomes.items()
        if (best := fastest[key]) is not None
        for o in row.values()
        if o.verified
    )

    def show(outcome: Outcome, _row: Mapping[str, Outcome]) -> Cell:
        return _ratio(outcome, fastest[outcome.case, outcome.tol])

    return Section(
        name="ratios",
        title="Ratios within blocks",
        prose=(
            "Total time over that of the fastest verified answer of the row, by pairs "
            "of measurements within blocks: what slows a whole block down cancels. "
            f"Mean of the logarithms, Student's {COVERAGE:.0%} interval. ≈: the "
            "interval holds 1, so that the two are not told apart. Blocks that both "
            "were measured in count; fewer than two make no interval.",
            *[_UNPAIRED] * apart,
        ),
        tables=(grid(evidence, "Ratio to the fastest, within blocks.", show),),
    )


def _ratio(outcome: Outcome, fastest: Outcome | None) -> Cell:
    if not outcome.verified:
        return Cell(text=ABSENT, title="not verified")
    if outcome is fastest:
        return Cell(text="1", value=1.0, kind="best", title=source(outcome))
    its = fastest.by_block if fastest else {}
    ratio = ratio_of(outcome.by_block, its)
    if ratio is None:
        return Cell(text=ABSENT, title="fewer than two blocks in common")
    tied = ratio.low <= 1 <= ratio.high
    return Cell(
        text=bracketed(ratio.value, ratio.low, ratio.high),
        symbol="≈" if tied else "",
        after="" if ratio.paired else "unpaired",
        kind="tied" if tied and not outcome.first.role else "",
        value=ratio.value,
        title=source(outcome),
    )


def _fastest(row: Mapping[str, Outcome]) -> Outcome | None:
    """Find the smallest median of a verified answer; null arms do not compete."""
    medians = {
        s: median(times)
        for s, o in row.items()
        if o.verified and not o.first.role and (times := [*o.by_block.values()])
    }
    return row[min(medians, key=lambda s: medians[s])] if medians else None


def precision(evidence: Evidence) -> Section | None:
    """Tabulate null arms and canaries; None where the records have neither."""
    null, canary = _null_table(evidence), _canary_table(evidence.records)
    tables = tuple(t for t in (null, canary) if t is not None)
    if not tables:
        return None
    prose = []
    if null is not None:
        prose.append(
            "One solver was measured twice under two labels, like any two solvers. "
            f"Its ratio of times is 1, and {COVERAGE:.0%} of the intervals ought to "
            f"hold 1. {_held(_null_ratios(evidence))}"
        )
    if canary is not None:
        prose.append(
            "Just before every measurement the worker times one small computation, the "
            "canary, which is always the same. Where its time changes, the machine has "
            "changed, and not a solver."
        )
    return Section(
        name="precision",
        title="How well the times are known",
        prose=tuple(prose),
        tables=tables,
    )


def _null_ratios(evidence: Evidence) -> list[tuple[Outcome, Outcome, Ratio]]:
    """Pair every null arm with the solver that it repeats, by their blocks."""
    found = []
    for row in evidence.outcomes.values():
        for null in (o for o in row.values() if o.first.role == "null"):
            twin = row.get(null.solver.replace(NULL, "", 1))
            if twin is None or not (null.verified and twin.verified):
                continue
            ratio = paired_ratio(null.by_block, twin.by_block)
            if ratio is not None:
                found.append((twin, null, ratio))
    return found


def _held(found: Sequence[tuple[Outcome, Outcome, Ratio]]) -> str:
    """Say how many intervals hold 1, and how wide they are."""
    held = sum(r.low <= 1 <= r.high for _, _, r in found)
    width = median(r.half_width for _, _, r in found)
    return (
        f"Here {held} of {plural(len(found), 'interval')} "
        f"{'does' if held == 1 else 'do'}; the median half-width is {width:.1%}. "
        "Ratios nearer to 1 than that tell no two solvers apart."
    )


def _null_table(evidence: Evidence) -> Table | None:
    found = _null_ratios(evidence)
    if not found:
        return None
    return Table(
        caption=f"A/A: ratio of the times of two equal solvers with its {COVERAGE:.0%} "
        "interval, by pairs within blocks.",
        columns=("case", "tol", "solver", "blocks", "ratio", "half-width", "holds 1"),
        rows=tuple(_null_row(*each) for each in found),
    )


def _null_row(twin: Outcome, null: Outcome, ratio: Ratio) -> tuple[Cell, ...]:
    held = ratio.low <= 1 <= ratio.high
    return (
        *case_cells(twin),
        Cell(text=clean(twin.solver, 40)),
        Cell(text=str(ratio.pairs), value=ratio.pairs),
        Cell(
            text=f"{ratio.value:.3f} [{ratio.low:.3f}, {ratio.high:.3f}]",
            value=ratio.value,
            title=source(null),
        ),
        Cell(text=f"{ratio.half_width:.1%}", value=ratio.half_width),
        Cell(text="yes" if held else "no", kind="" if held else "over"),
    )


def _canary_table(records: Sequence[Record]) -> Table | None:
    """Describe the canary of every solver's worker, and of all."""
    timed = [r for r in records if r.canary_seconds and r.started]
    if not timed:
        return None
    timed.sort(key=lambda r: r.started)
    solvers = list(dict.fromkeys(r.solver for r in records))
    groups = [(s, [r for r in timed if r.solver == s]) for s in solvers]
    rows = [_canary_row(name, mine) for name, mine in groups if mine]
    return Table(
        caption="Canary in the worker of each solver: median and interval, the span "
        "that nine tenths lie in relative to the median, and the drift from the first "
        "to the last third of the measurements.",
        columns=("solver", "measurements", "canary", "nine tenths", "drift"),
        rows=(*rows, _canary_row("all", timed, kind="total")),
    )


def _canary_row(name: str, mine: Sequence[Record], kind: str = "") -> tuple[Cell, ...]:
    times = [r.canary_seconds for r in mine if r.canary_seconds]
    middle = median(times)
    low, high = np.quantile(times, (0.05, 0.95)) / middle - 1
    span = f"{low:+.1%} to {high:+.1%}" if len(times) > 1 else ABSENT
    third = len(times) // _PARTS
    drift = median(times[-third:]) / median(times[:third]) - 1 if third else None
    return (
        Cell(**{**vars(name_cell(name)), "kind": kind}),
        Cell(text=str(len(times)), value=len(times), kind=kind),
        Cell(text=seconds(median_interval(times)), value=middle, kind=kind),
        Cell(text=span, value=None if span == ABSENT else high - low, kind=kind),
        Cell(text=ABSENT if drift is None else f"{drift:+.1%}", value=drift, kind=kind),
    )
