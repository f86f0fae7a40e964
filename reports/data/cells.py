"""Cells and tables made from outcomes, alike in every section."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.document.formatting import (
    ABSENT,
    VERDICTS,
    clean,
    plural,
    tolerance,
)
from mortarbench.reports.document.layout import Cell, Table, name_cell, sources

#: after a verdict that a proven optimum decided against the residuals
BY_OPTIMUM = "⋆"


def source(*outcomes: Outcome) -> str:
    """Name the measurements behind a cell; `named` reads them back."""
    return sources(r for o in outcomes for r in o.records)


def verdict_cell(outcome: Outcome, after: str = "") -> Cell:
    """Show a verdict with symbol and words, and how many repeats it holds for."""
    symbol, words = VERDICTS[outcome.verdict]
    if outcome.against_residuals:
        words += f" {BY_OPTIMUM}"
    alike = sum(r.verdict is outcome.verdict for r in outcome.records)
    if alike < len(outcome.records):
        words += f" ({alike} of {plural(len(outcome.records), 'repeat')})"
    return Cell(
        text=words,
        symbol=symbol,
        after=after,
        kind=outcome.verdict.value,
        title=source(outcome),
    )


def legend(rows: Iterable[Iterable[Cell]]) -> tuple[str, ...]:
    """Explain the mark of a proven optimum as a note, if a verdict in a table has it.

    rows : of the table
    """
    kinds = {verdict.value for verdict in VERDICTS}
    marked = any(c.kind in kinds and BY_OPTIMUM in c.text for row in rows for c in row)
    note = (
        f"{BY_OPTIMUM}: decided by the proven optimum of a small QP, against the "
        "residuals."
    )
    return (note,) if marked else ()


def case_cells(outcome: Outcome | Mapping[str, Outcome]) -> tuple[Cell, Cell]:
    """Make the two leading cells of a row: case and tolerance."""
    one = outcome if isinstance(outcome, Outcome) else next(iter(outcome.values()))
    return name_cell(one.case), Cell(text=tolerance(one.tol), value=one.tol)


def grid(
    evidence: Evidence,
    caption: str,
    show: Callable[[Outcome, Mapping[str, Outcome]], Cell],
) -> Table:
    """Make a table with a row per (case, tol) and a column per solver."""
    rows = []
    for row in evidence.outcomes.values():
        cells = [
            show(row[s], row) if s in row else Cell(text=ABSENT, title="not run")
            for s in evidence.solvers
        ]
        rows.append((*case_cells(row), *cells))
    return Table(
        caption=caption,
        notes=legend(rows),
        columns=("case", "tol", *(clean(s, 40) for s in evidence.solvers)),
        rows=tuple(rows),
    )
