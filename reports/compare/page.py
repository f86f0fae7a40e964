"""Page that compares two result folders: changes and conditions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from mortarbench.reports.compare.changes import (
    Comparison,
    Mean,
    Pair,
    mean_ratio,
    relative_ratio,
    side,
)
from mortarbench.reports.compare.conclusions import (
    cell_name,
    change_word,
    dates,
    named,
    ratio_text,
    sentences,
)
from mortarbench.reports.compare.conditions import environments, options, settings
from mortarbench.reports.compare.figure import ratios_figure
from mortarbench.reports.data.cells import (
    answer_columns,
    iterations_cell,
    source,
    verdict_cell,
)
from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.document.formatting import (
    ABSENT,
    TIMED,
    VERDICTS,
    clean,
    power,
    seconds,
    significant,
)
from mortarbench.reports.document.layout import (
    Cell,
    Column,
    Page,
    Part,
    Picture,
    Point,
    Section,
    Table,
)
from mortarbench.reports.document.templates import Sentences

TEXT = Sentences(__name__, cell_name=cell_name)


def compose(c: Comparison) -> Page:
    """Compose the page: summary, changes, then the conditions that differ."""
    names = [clean(e.directory.resolve().name, 40) for e in (c.before, c.after)]
    sections = (
        Section.of(name, title, list(write(c)) or ["None."])
        for name, title, write in (
            ("summary", "Summary", _summary),
            ("times", "Times", _times),
            ("verdicts", "Verdicts", _verdicts),
            ("iterations", "Iterations", _iterations),
            ("answers", "Answers", _answers),
            ("unpaired", "In one folder only", _unpaired),
            ("conditions", "Conditions that differ", conditions_that_differ),
        )
    )
    return Page(
        title=f"{clean(c.after.name)}: changes from {names[0]} to {names[1]}",
        dateline=dates(c),
        sections=tuple(s for s in sections if s is not None),
        footer=TEXT("footer"),
    )


def _summary(c: Comparison) -> Iterator[Part]:
    yield from sentences(c)
    yield from map(Point, named(c))
    rows = []
    for solver in c.solvers:
        relative = relative_ratio(c, solver)
        means = _mean_cells(mean_ratio(c.of(solver)))
        rows.append((Cell.name(solver), *means, Cell.number(relative, ratio_text)))
    if (mean := mean_ratio(c.pairs)) is not None:
        total = Cell(text="all", kind="total")
        rows.append((total, *_mean_cells(mean, "total"), Cell(kind="total")))
    yield Table(
        caption=TEXT("means"),
        columns=("solver", "cells", "ratio", "change", "relative to the others"),
        rows=tuple(rows),
    )


def _mean_cells(mean: Mean | None, kind: str = "") -> tuple[Cell, ...]:
    if mean is None:
        return Cell.number(0), Cell(), Cell()
    way = side(mean)
    return (
        Cell.number(mean.cells, kind=kind),
        Cell.number(mean, ratio_text, kind=kind),
        Cell(text=change_word(mean), value=way, kind="over" if way > 0 else kind),
    )


def _times(c: Comparison) -> Iterator[Part]:
    yield TEXT("times")
    shown = [p for p in c.pairs if all(o.seconds("total") for o in (p.before, p.after))]
    if shown:
        yield Table.of(
            f"Times before and after. {TIMED}",
            shown,
            (
                *_PAIR,
                ("before", lambda p: time_cell(p.before, voided=p.log is None)),
                ("after", lambda p: time_cell(p.after, voided=p.log is None)),
                ("ratio", _ratio),
                ("change", _change),
            ),
            text_columns=2,
        )
    if any(p.log is not None for p in c.pairs):
        figure = ratios_figure(c)
        yield Picture(name="ratios", caption=TEXT("ratios"), figure=figure)


def _ratio(p: Pair) -> Cell:
    if p.ratio is None:
        return Cell()
    return Cell.number(p.ratio, ratio_text, title=source(p.after))


def _change(p: Pair) -> Cell:
    if p.ratio is not None:
        kind = {1: "over", 0: "quiet", -1: ""}[p.change]
        return Cell(text=change_word(p.ratio), value=p.change, kind=kind)
    if not p.same_machine:
        return Cell(text="other machine", kind="quiet")
    if not p.same_problem:
        return Cell(text="other QP", kind="quiet")
    why = "1 repeat" if p.both_verified else "not comparable"
    return Cell(text=why, kind="quiet")


def time_cell(outcome: Outcome, *, voided: bool) -> Cell:
    """Return a cell with a time, and with the verdict if the answer is not verified."""
    return Cell.number(
        outcome.seconds("total"),
        seconds,
        after="" if outcome.verified else VERDICTS[outcome.verdict][1],
        kind="void" if voided else "",
        title=source(outcome),
    )


def _verdicts(c: Comparison) -> Iterator[Part]:
    def turn(p: Pair) -> Cell:
        if p.turn > 0:
            return Cell(text="worse", value=p.turn, kind="over")
        return Cell(text="better", value=p.turn)

    turned = sorted((p for p in c.pairs if p.turn), key=lambda p: -p.turn)
    return _listed(
        TEXT("verdicts"),
        turned,
        (
            *_PAIR,
            ("before", lambda p: verdict_cell(p.before, power(p.before.worst))),
            ("after", lambda p: verdict_cell(p.after, power(p.after.worst))),
            ("change", turn),
        ),
    )


def _iterations(c: Comparison) -> Iterator[Part]:
    columns = (
        *_PAIR,
        ("before", lambda p: iterations_cell(p.before)),
        ("after", lambda p: iterations_cell(p.after)),
    )
    changed = [p for p in c.pairs if p.other_iterations]
    return _listed(TEXT("iterations"), changed, columns)


def _answers(c: Comparison) -> Iterator[Part]:
    def energy(k: int) -> Callable[[Pair], Cell]:
        return lambda p: Cell.number(
            p.answers and p.answers[k], lambda v: significant(v, 12)
        )

    return _listed(
        TEXT("answers"),
        [p for p in c.pairs if p.other_answer],
        (
            *_PAIR,
            ("before", energy(0)),
            ("after", energy(1)),
            ("difference", lambda p: Cell.power(p.answers and p.answers[2])),
            ("allowed", lambda p: Cell.power(p.may_differ)),
        ),
    )


def _unpaired(c: Comparison) -> Iterator[Part]:
    alone = [("before", o) for o in c.only_before]
    alone += [("after", o) for o in c.only_after]
    columns = (
        *answer_columns(lambda each: each[1]),
        ("only", lambda each: Cell.words(each[0])),
        ("verdict", lambda each: verdict_cell(each[1])),
    )
    return _listed("Cells that are only in one folder.", alone, columns)


_PAIR = answer_columns(lambda pair: pair.after)


def _listed(
    caption: str, items: Sequence[Any], columns: Sequence[Column]
) -> Iterator[Table]:
    """Yield a table of the items; yield nothing without items."""
    if items:
        yield Table.of(caption, items, columns, text_columns=2)


def conditions_that_differ(c: Comparison) -> Iterator[Part]:
    """Tabulate differences of environments, settings, options and QPs."""
    found = {
        "Environments, as recorded.": environments(c.before, c.after),
        "Settings of the suites.": settings(c.before, c.after),
        "Options of solvers with the same label.": options(c.before, c.after),
    }
    others = [p for p in c.pairs if not p.same_qp]
    yield from TEXT.parts("conditions", any(found.values()), others)
    columns: tuple[Column, ...] = (
        ("key", lambda each: Cell.label(each[0], 96)),
        ("before", lambda each: _plain(each[1])),
        ("after", lambda each: _plain(each[2])),
    )
    yield from (Table.of(text, of, columns) for text, of in found.items() if of)


def _plain(value: object) -> Cell:
    return Cell.words(ABSENT if value is None else clean(str(value), 120))
