"""One solve on several ranks: strong and weak scaling, parts of times."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from mortarbench.reports.data.cells import answer_columns, iterations_cell, source
from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.data.rank_series import (
    ALIKE,
    PHASES,
    Member,
    Part,
    StrongSeries,
    WeakSeries,
    rank_counts,
    rank_memory,
    rank_parts,
    strong_series,
    weak_series,
)
from mortarbench.reports.document import layout
from mortarbench.reports.document.figure import Figure
from mortarbench.reports.document.formatting import TIMED, significant
from mortarbench.reports.document.layout import Cell, Picture, Table
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.figures.ranks import (
    parts_figure,
    strong_figure,
    weak_figure,
)
from mortarbench.reports.sections import Analysis, section
from mortarbench.reports.statistics.intervals import Interval

MOST_DRAWN = 4  #: largest number of series in a figure; all are tabulated
_CROWDED = "more ranks than CPUs: ranks shared CPUs"
TEXT = Sentences(__name__, ALIKE=ALIKE, MOST_DRAWN=MOST_DRAWN)

#: a series, a number of ranks, and the answer on this number of ranks
Solve = tuple[StrongSeries, int, Outcome]
_ONE = Cell(text="1", value=1.0)
_SERIES = ("case", "solver", "tol")


@section(
    66,
    "ranks",
    "One solve on several ranks",
    "One solve on several ranks: no case was verified both on one rank and on "
    "several; set ranks = [1, 2] in the suite (see suites/ranks.toml).",
)
def ranks(a: Analysis) -> Iterator[layout.Part]:
    """Tabulate and draw solves on several ranks."""
    strong, weak = strong_series(a.evidence), weak_series(a.evidence)
    if not strong and not weak:
        return
    crowded = any(s.crowded(n) for s in strong for n in s.several) or any(
        s.crowded(m.ranks) for s in weak for m in s.members
    )
    yield from TEXT.parts("prose", strong, weak, crowded)
    solves = [(s, n, s.answers[n]) for s in strong for n in s.answers]
    if strong:
        yield _strong_table(solves, "prepare")
        yield _strong_table(solves, "solve")
    yield from map(_weak_table, weak)
    several = [each for each in solves if each[1] in each[0].several]
    yield from _part_tables(several)
    yield from _pictures(strong, weak)


def _ratio(interval: Interval | None, title: str, kind: str = "") -> Cell:
    if interval is None:
        return Cell()
    if interval.samples > 1:
        return Cell.ratio(interval, title=title, kind=kind)
    text = f"{significant(interval.value)} [1 run]"
    return Cell(text=text, value=interval.value, title=title, kind=kind)


def _ranks(n: int, kind: str) -> Cell:
    return Cell.number(n, kind=kind, title=_CROWDED if kind else "")


def _series(s: StrongSeries) -> tuple[Cell, ...]:
    return tuple(cell(s) for _, cell in answer_columns())


def _strong_table(solves: Sequence[Solve], phase: str) -> Table:
    def row(s: StrongSeries, n: int, o: Outcome) -> tuple[Cell, ...]:
        kind = "quiet" if s.crowded(n) else ""
        time = Cell.time(o.seconds(phase), title=source(o), kind=kind)
        shown = (*_series(s), _ranks(n, kind), iterations_cell(o), time)
        if n == 1:
            return (*shown, _ONE, _ONE)
        alone = s.answers[1]
        return (
            *shown,
            _ratio(s.speed_up(n, phase), source(alone, o), kind),
            _ratio(s.efficiency(n, phase), source(alone, o), kind),
        )

    return Table(
        caption=TEXT("strong_caption", phase),
        columns=(
            *_SERIES,
            "ranks",
            "iterations",
            "time",
            "speed-up",
            "efficiency",
        ),
        rows=tuple(row(*each) for each in solves),
        text_columns=2,
        notes=(TIMED,),
    )


def _weak_table(series: WeakSeries) -> Table:
    def row(m: Member) -> Iterator[Cell]:
        o, kind = m.answer, "quiet" if series.crowded(m.ranks) else ""
        runs = source(series.members[0].answer, o)
        yield _ranks(m.ranks, kind)
        yield Cell.number(m.dofs)
        yield Cell.number(m.dofs // m.ranks)
        yield iterations_cell(o)
        for phase in PHASES:
            yield Cell.time(o.seconds(phase), title=source(o), kind=kind)
            if m.ranks == 1:
                yield _ONE
            else:
                yield _ratio(series.efficiency(m, phase), runs, kind)

    return Table(
        caption=f"Weak scaling: {series.title}.",
        columns=(
            "ranks", "dofs", "dofs of a rank", "iterations", "prepare", "efficiency",
            "solve", "efficiency",
        ),
        rows=tuple(tuple(row(m)) for m in series.members),
        text_columns=0,
        notes=(TIMED,),
    )  # fmt: skip


def _part_tables(solves: Sequence[Solve]) -> Iterator[Table]:
    """Tabulate the recorded times, messages and memory of the ranks."""
    parts = [rank_parts(o) for *_, o in solves]
    counts = [rank_counts(o) for *_, o in solves]
    if any(parts):
        names = dict.fromkeys(name for of in parts for name in of)
        rows = []
        for (s, n, o), of in zip(solves, parts, strict=True):
            time = o.seconds("solve")
            whole = Cell.number(time and time.value, significant, title=source(o))
            spent = sum(part.mean for part in of.values())
            rest = max(time.value - spent, 0.0) if time and of else None
            shown = (_part(of.get(name), o) for name in names)
            left = Cell.number(rest, significant)
            rows.append((*_series(s), Cell.number(n), whole, *shown, left))
        yield Table(
            caption=TEXT("parts_caption"),
            columns=(*_SERIES, "ranks", "solve", *names, "rest"),
            rows=tuple(rows),
            text_columns=2,
            notes=(TEXT("parts_note"),),
        )
    if any(counts):
        names = dict.fromkeys(name for of in counts for name in of)
        yield Table(
            caption=TEXT("sent_caption"),
            columns=(*_SERIES, "ranks", *names, "peak, MiB"),
            rows=tuple(
                (
                    *_series(s),
                    Cell.number(n),
                    *(_part(of.get(name), o) for name in names),
                    _part(rank_memory(o), o),
                )
                for (s, n, o), of in zip(solves, counts, strict=True)
            ),
            text_columns=2,
        )


def _part(part: Part | None, o: Outcome) -> Cell:
    if part is None:
        return Cell()
    text = f"{significant(part.mean)} [{significant(part.largest)}]"
    return Cell(text=text, value=part.mean, title=source(o))


def _pictures(
    strong: Sequence[StrongSeries], weak: Sequence[WeakSeries]
) -> Iterator[Picture]:
    timed = [(s, n) for s in strong for n in s.several if rank_parts(s.answers[n])]
    drawn: tuple[tuple[str, Sequence[object], Callable[[], Figure]], ...] = (
        ("strong", strong, lambda: strong_figure(strong[:MOST_DRAWN])),
        ("parts", timed, lambda: parts_figure(timed[: 3 * MOST_DRAWN])),
        ("weak", weak, lambda: weak_figure(weak[:MOST_DRAWN])),
    )
    for name, shown_series, draw in drawn:
        if shown_series:
            caption = TEXT(name, len(shown_series))
            yield Picture(name=f"ranks-{name}", caption=caption, figure=draw())
