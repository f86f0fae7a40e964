"""How well the times are known: what equal solvers differ by, and how the machine ran.

Both need arms and canaries in the records; journals from before have neither.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

import numpy as np

from harness import Record
from harness.running.pairs import COVERAGE, Ratio, paired_ratio
from harness.suite.suite import NULL
from reports.data.evidence import Evidence, Outcome
from reports.document.formatting import ABSENT, clean, plural, seconds
from reports.document.layout import Cell, Section, Table, name_cell
from reports.sections.cells import case_cells, source
from reports.sections.ratios import by_repeat
from reports.statistics.intervals import median_interval

_PARTS = 3  #: the canary's drift compares the last third with the first


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
            f"hold 1. {_held(_ratios(evidence))}"
        )
    if canary is not None:
        prose.append(
            "Just before every measurement the worker times a small kernel that is "
            "always the same: where that moves, the machine moved, not a solver."
        )
    return Section(
        name="precision",
        title="How well the times are known",
        prose=tuple(prose),
        tables=tables,
    )


def _ratios(evidence: Evidence) -> list[tuple[Outcome, Outcome, Ratio]]:
    """Pair every null arm with the solver that it repeats, by their blocks."""
    found = []
    for row in evidence.outcomes.values():
        for null in (o for o in row.values() if o.first.arm == "null"):
            twin = row.get(null.solver.replace(NULL, "", 1))
            if twin is None or not (null.verified and twin.verified):
                continue
            ratio = paired_ratio(by_repeat(null), by_repeat(twin))
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
    found = _ratios(evidence)
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
