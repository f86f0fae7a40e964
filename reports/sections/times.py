"""Times of verified answers, their ratios, and their precision.

The precision is measured by null arms (a solver repeated under a second label) and by
canaries (a fixed computation that is timed before each measurement). Journals of older
versions contain neither.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import NamedTuple

from mortarbench.harness.running.pairs import Ratio, paired_ratio, ratio_of
from mortarbench.harness.suite.solver_options import NULL_SUFFIX
from mortarbench.reports.data.cells import (
    case_cells,
    grid,
    source,
)
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.document.formatting import (
    TIMED,
    VERDICTS,
    clean,
    estimate,
    fixed,
    seconds,
)
from mortarbench.reports.document.layout import Cell, Part, Picture, Table
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.figures.sweeps import accuracy_figure
from mortarbench.reports.sections import Analysis, section
from mortarbench.reports.statistics.intervals import COVERAGE

TEXT = Sentences(__name__, LEAST=COVERAGE)


@section(20, "times", "Times")
def times(a: Analysis) -> Iterator[Part]:
    """Compare the total times of verified answers, and draw accuracy against time."""
    intervals = [o.seconds("total") for o in a.evidence.flat]
    known = [i for i in intervals if i is not None and i.samples > 1]
    coverage = {i.samples: i.coverage for i in known}
    weakest = min(known, key=lambda i: i.coverage, default=None)
    yield from TEXT.parts("times", sorted(coverage.items()), weakest)
    yield grid(a.evidence, f"Total time, median and interval. {TIMED}", _time)
    charged = [
        row
        for row in a.evidence.outcomes.values()
        if any(o.with_dualising is not None and o.verified for o in row.values())
    ]
    if charged:
        yield _charged_table(charged, a.evidence.solvers)
    figure = accuracy_figure(a.evidence)
    if figure is not None:
        caption = TEXT("accuracy")
        yield Picture(name="accuracy", caption=caption, figure=figure)


def _charged_table(
    charged: Sequence[Mapping[str, Outcome]], solvers: Sequence[str]
) -> Table:
    """Tabulate total times of dual forms including dualisation, if it was timed."""
    rows = []
    for row in charged:
        one = next(o for o in row.values() if o.dualising is not None)
        totals = {s: o.with_dualising for s, o in row.items() if o.verified}
        ranked = [t.value for s, t in totals.items() if t and not row[s].first.arm]
        kinds = {min(ranked, default=None): "best"}
        cells = (
            Cell.time(total, kind=kinds.get(total.value, ""), title=source(row[s]))
            if (total := totals.get(s))
            else Cell(kind="quiet")
            for s in solvers
        )
        dualising = Cell.time(one.dualising, title=source(one))
        rows.append((*case_cells(row), dualising, *cells))
    heads = ("case", "tol", "dualisation", *(clean(s, 40) for s in solvers))
    return Table(caption=TEXT("charged_caption"), columns=heads, rows=tuple(rows))


def _time(outcome: Outcome, row: Mapping[str, Outcome]) -> Cell:
    interval, title = outcome.seconds("total"), source(outcome)
    symbol, ending = VERDICTS[outcome.verdict]
    if interval is None:
        ending = "reuses answers" if outcome.remembered else ending
        return Cell(text=ending, symbol=symbol, kind="quiet", title=title)
    if not outcome.verified:
        return Cell(text=seconds(interval), after=ending, kind="void", title=title)
    if outcome.first.arm:  # null arms do not compete
        return Cell.time(interval, title=title)
    rivals = [
        o.seconds("total") for o in row.values() if o.verified and not o.first.arm
    ]
    fastest = min((i for i in rivals if i is not None), key=lambda i: i.value)
    if interval == fastest:
        return Cell.time(interval, kind="best", title=title)
    if interval.low <= fastest.high and interval.samples > 1:
        return Cell.time(interval, symbol="≈", kind="tied", title=title)
    return Cell.time(interval, title=title)


@section(
    22,
    "ratios",
    "Ratios within blocks",
    "Ratios within blocks: every solver was measured only once. Paired times need "
    "repeats, for example repeats = 3 in the suite or --repeats 3.",
)
def ratios(a: Analysis) -> Iterator[Part]:
    """Tabulate ratios to the fastest verified answer; yield nothing without repeats."""
    if not any(len(o.records) > 1 for o in a.evidence.flat):
        return
    fastest = {key: _fastest(row) for key, row in a.evidence.outcomes.items()}
    apart = any(
        (relative := ratio_of(o.by_block, best.by_block)) and not relative.paired
        for key, row in a.evidence.outcomes.items()
        if (best := fastest[key]) is not None
        for o in row.values()
        if o.verified and o is not best
    )

    def ratio(outcome: Outcome, _row: Mapping[str, Outcome]) -> Cell:
        best = fastest[outcome.case, outcome.tol]
        if not outcome.verified:
            return Cell(title="not verified")
        if outcome is best:
            return Cell(text="1", value=1.0, kind="best", title=source(outcome))
        relative = ratio_of(outcome.by_block, best.by_block if best else {})
        if relative is None:
            return Cell(title="fewer than two blocks in common")
        tied = relative.low <= 1 <= relative.high
        return Cell.number(
            relative,
            estimate,
            symbol="≈" if tied else "",
            after="" if relative.paired else "unpaired",
            kind="tied" if tied and not outcome.first.arm else "",
            title=source(outcome),
        )

    yield from TEXT.parts("ratios", apart)
    yield grid(a.evidence, "Total time relative to the fastest, within blocks.", ratio)


def _fastest(row: Mapping[str, Outcome]) -> Outcome | None:
    """Return the verified answer with the smallest median time; ignore null arms."""
    medians = {
        s: median(times)
        for s, o in row.items()
        if o.verified and not o.first.arm and (times := [*o.by_block.values()])
    }
    return row[min(medians, key=lambda s: medians[s])] if medians else None


class _Twins(NamedTuple):
    """One solver measured under two labels, and its ratio of times within blocks."""

    twin: Outcome
    null: Outcome
    ratio: Ratio

    @property
    def equal(self) -> bool:
        return self.ratio.low <= 1 <= self.ratio.high


@section(
    24,
    "precision",
    "Precision of the times",
    "Precision of the times: the suite does not measure a solver twice (null_arm).",
)
def precision(a: Analysis) -> Iterator[Part]:
    """Tabulate null arms; yield nothing if the records have none."""
    if null := _null_ratios(a.evidence):
        width = median(each.ratio.half_width for each in null)
        covering = sum(each.equal for each in null)
        yield from TEXT.parts("null_arm", covering, len(null), width)
        yield Table.of(
            TEXT("null_caption"),
            null,
            (
                ("case", lambda t: Cell.name(t.twin.case)),
                ("tol", lambda t: Cell.tolerance(t.twin.tol)),
                ("solver", lambda t: Cell.label(t.twin.solver)),
                ("blocks", lambda t: Cell.number(t.ratio.pairs)),
                ("ratio", lambda t: Cell.number(t.ratio, fixed, title=source(t.null))),
                (
                    "half-width",
                    lambda t: Cell.number(t.ratio.half_width, "{:.1%}".format),
                ),
                (
                    "contains 1",
                    lambda t: (
                        Cell(text="yes") if t.equal else Cell(text="no", kind="over")
                    ),
                ),
            ),
        )


def _null_ratios(evidence: Evidence) -> list[_Twins]:
    """Compare every null arm with the solver that it repeats, within blocks."""
    twins = []
    for row in evidence.outcomes.values():
        for null in (o for o in row.values() if o.first.arm == "null"):
            twin = row.get(null.solver.replace(NULL_SUFFIX, "", 1))
            if twin is not None and null.verified and twin.verified:
                ratio = paired_ratio(null.by_block, twin.by_block)
                twins += [_Twins(twin, null, ratio)] if ratio is not None else []
    return twins
