"""Paired ratios: how many times as long as the fastest, block by block."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import median

from harness.running.pairs import COVERAGE, paired_ratio
from reports.data.evidence import Evidence, Outcome
from reports.document.formatting import ABSENT, bracketed
from reports.document.layout import Cell, Section
from reports.sections.cells import grid, source


def ratios(evidence: Evidence) -> Section | None:
    """Tabulate ratios to the fastest verified answer; None without repeats."""
    if not any(len(o.records) > 1 for o in evidence.flat):
        return None
    fastest = {key: _fastest(row) for key, row in evidence.outcomes.items()}

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
        ),
        tables=(grid(evidence, "Ratio to the fastest, within blocks.", show),),
    )


def by_repeat(outcome: Outcome) -> dict[int, float]:
    """Total seconds of each repeat that has them; repeats are of equal blocks."""
    return {r.repeat: r.total_seconds for r in outcome.records if r.total_seconds}


def _ratio(outcome: Outcome, fastest: Outcome | None) -> Cell:
    if not outcome.verified:
        return Cell(text=ABSENT, title="not verified")
    if outcome is fastest:
        return Cell(text="1", value=1.0, kind="best", title=source(outcome))
    its = by_repeat(fastest) if fastest else {}
    ratio = paired_ratio(by_repeat(outcome), its)
    if ratio is None:
        return Cell(text=ABSENT, title="fewer than two blocks in common")
    tied = ratio.low <= 1 <= ratio.high
    return Cell(
        text=bracketed(ratio.value, ratio.low, ratio.high),
        symbol="≈" if tied else "",
        kind="tied" if tied and not outcome.first.arm else "",
        value=ratio.value,
        title=source(outcome),
    )


def _fastest(row: Mapping[str, Outcome]) -> Outcome | None:
    """Find the smallest median of a verified answer; null arms do not compete."""
    medians = {
        s: median(times)
        for s, o in row.items()
        if o.verified and not o.first.arm and (times := [*by_repeat(o).values()])
    }
    return row[min(medians, key=lambda s: medians[s])] if medians else None
