"""Cells and tables of outcomes, shared by all sections."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Any

from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.document.formatting import VERDICTS, clean, plural, span
from mortarbench.reports.document.layout import Cell, Column, Table, sources


def source(*outcomes: Outcome) -> str:
    """Return hover text with the run_ids of outcomes, which `named` can extract."""
    return sources(r for o in outcomes for r in o.records)


def verdict_cell(outcome: Outcome, after: str = "", message: str = "") -> Cell:
    """Return a cell with a verdict; if repeats differ, add how many have this verdict.

    message : message of the solver, shown on hovering
    """
    symbol, words = VERDICTS[outcome.verdict]
    alike = sum(r.status is outcome.verdict for r in outcome.records)
    if alike < len(outcome.records):
        words += f" ({alike} of {plural(len(outcome.records), 'repeat')})"
    return Cell(
        text=words,
        symbol=symbol,
        after=after,
        kind=outcome.verdict.value,
        title=f"{message} · {source(outcome)}" if message else source(outcome),
    )


def iterations_cell(outcome: Outcome, form: str = "{}", kind: str = "") -> Cell:
    """Return a cell with the number of iterations, a range if repeats differ."""
    its, title = outcome.iterations, source(outcome)
    if its is None:
        return Cell(kind=kind, title=title)
    return Cell(text=form.format(span(its)), value=its[0], kind=kind, title=title)


def answer_columns(
    of: Callable[[Any], Any] = lambda item: item,
) -> tuple[Column, ...]:
    """Return the leading columns of a table of answers: case, solver and tolerance.

    of : maps an item to the object with these attributes; default: the item itself
    """
    return (
        ("case", lambda item: Cell.name(of(item).case)),
        ("solver", lambda item: Cell.label(of(item).solver)),
        ("tol", lambda item: Cell.tolerance(of(item).tol)),
    )


def solver_columns(
    solvers: Iterable[str], cell: Callable[[str, Any], Cell]
) -> Iterator[Column]:
    """Yield a column per solver; `cell` maps solver and item to the entry."""
    return ((clean(s, 40), partial(cell, s)) for s in solvers)


def case_cells(outcome: Outcome | Mapping[str, Outcome]) -> tuple[Cell, Cell]:
    """Return the two leading cells of a row: case and tolerance."""
    one = outcome if isinstance(outcome, Outcome) else next(iter(outcome.values()))
    return Cell.name(one.case), Cell.tolerance(one.tol)


def grid(
    evidence: Evidence,
    caption: str,
    show: Callable[[Outcome, Mapping[str, Outcome]], Cell],
) -> Table:
    """Return a table with a row per (case, tol) and a column per solver."""
    absent = Cell(title="not run")
    rows = tuple(
        (
            *case_cells(row),
            *(show(row[s], row) if s in row else absent for s in evidence.solvers),
        )
        for row in evidence.outcomes.values()
    )
    heads = ("case", "tol", *(clean(s, 40) for s in evidence.solvers))
    return Table(caption=caption, columns=heads, rows=rows)
