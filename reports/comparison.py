"""Report on the changes between two runs, or between two solvers of one run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from mortarbench.harness.results.folder import differences
from mortarbench.reports.compare import Change, Outcome
from mortarbench.reports.document import (
    ABSENT,
    Document,
    Item,
    Section,
    Table,
    clean,
    interval,
    number,
    plural,
    short_name,
    tolerance,
)
from mortarbench.reports.measurements import Measurements
from mortarbench.reports.writing import write_document

MOST_CELLS = 12  #: largest number of cells in a table
MOST_CHANGES = 8  #: largest number of changed conditions that the first line names


def conditions(
    before: Measurements, after: Measurements, pairs: Sequence[tuple[str, str]]
) -> str:
    """State in one line which options, versions and machines differ."""
    changed = []
    for old, new in pairs:
        a: Mapping[str, Any]
        b: Mapping[str, Any]
        a, b = (
            next(iter(run.df[run.df.solver == label].options), {})
            for run, label in ((before, old), (after, new))
        )
        changed += [
            f"{new}.{key} {a[key]} → {b[key]}"
            for key in a
            if key in b and a[key] != b[key]
        ]
    one, other = (next(iter(run.environments.values()), {}) for run in (before, after))
    if one != other:
        changed += [f"{key} {a} → {b}" for key, a, b in differences(one, other)]
    if not changed:
        return "Same options, versions and machine."
    more = f" and {len(changed) - MOST_CHANGES} more" * (len(changed) > MOST_CHANGES)
    shown = "; ".join(clean(c, 80) for c in islice(changed, MOST_CHANGES))
    return f"Changed: {shown}{more}."


def sentences(changes: Sequence[Change], limit: float) -> list[str]:
    """Return the judgements: slower solvers first, then undecided ones."""
    order = (Outcome.SLOWER, Outcome.CANNOT_TELL, Outcome.NOT_SLOWER)
    ranked = sorted(changes, key=lambda c: order.index(c.outcome(limit)))
    lines = [change.sentence(limit) for change in ranked]
    for change in ranked:
        if len(change.worse):
            first = change.worse.iloc[0]
            lines.append(
                f"worse: {change.name} on {plural(len(change.worse), 'cell')}, such as "
                f"{clean(first.case)}: {first.old} → {first.new}"
            )
    return lines


def write_comparison(
    target: Path,
    title: str,
    changes: Sequence[Change],
    said: Sequence[str],
    formats: Sequence[str],
) -> list[Path]:
    """Write the report on changes to a folder.

    said : the conditions, and the judgements
    """
    items: list[Item] = [*said, _table(changes)]
    sections = [Section(name="changes", title="Changes", items=tuple(items))]
    for name, heading, found in (
        ("statuses", "Changed statuses", _statuses(changes)),
        ("cells", "Largest changes of times", _cells(changes)),
    ):
        if tables := tuple(found):
            sections.append(Section(name=name, title=heading, items=tables))
    document = Document(
        title=clean(title),
        dateline="",
        sections=tuple(sections),
        solvers=tuple(dict.fromkeys(c.after for c in changes)),
        footer="Tables: tables/*.csv and tables/*.tex.",
    )
    return write_document(document, target, formats)


def _table(changes: Sequence[Change]) -> Table:
    return Table(
        name="changes",
        head=("solver", "time after / before", "95 % interval", "cells", "repeats"),
        rows=tuple(
            (
                clean(c.name, 60),
                number(c.ratio.value) if c.ratio else ABSENT,
                interval(c.ratio, 3) if c.ratio else "",
                str(c.cells),
                number(c.repeats, 2),
            )
            for c in changes
        ),
        caption="Geometric mean, over the cells that were verified both times, of the "
        "time after relative to before, with the interval by Welch (two runs) or "
        "Student (two solvers of one run) from the scatter of the repeats, and the "
        "error of processes. A cell is a case at a tolerance.",
    )


def _statuses(changes: Sequence[Change]) -> Iterator[Table]:
    rows = [
        (short_name(c.name), clean(r.case), tolerance(r.tol), f"{r.old} → {r.new}")
        for c in changes
        for r in c.statuses.sort_values("turn").itertuples()
    ]
    if rows:
        yield Table(
            name="statuses",
            head=("solver", "case", "tol", "status"),
            rows=tuple(rows[:MOST_CELLS]),
            caption=f"The worst of {plural(len(rows), 'change')} of status.",
            texts=2,
        )


def _cells(changes: Sequence[Change]) -> Iterator[Table]:
    rows = [
        (r.ratio, short_name(c.name), clean(r.case), tolerance(r.tol))
        for c in changes
        for r in c.by_cell.itertuples()
    ]
    rows.sort(key=lambda row: -row[0])
    if rows:
        yield Table(
            name="cells",
            head=("solver", "case", "tol", "time after / before"),
            rows=tuple((*row, number(ratio)) for ratio, *row in rows[:MOST_CELLS]),
            caption="Cells with the largest ratios.",
            texts=2,
        )
