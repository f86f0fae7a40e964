"""One solve on several ranks: strong and weak scaling."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from mortarbench.reports.data.cells import answer_columns, iterations_cell, source
from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.data.rank_series import (
    ALIKE,
    PHASES,
    Member,
    StrongSeries,
    WeakSeries,
    rank_memory,
    strong_series,
    weak_series,
)
from mortarbench.reports.document import layout
from mortarbench.reports.document.figure import Figure
from mortarbench.reports.document.formatting import TIMED, significant
from mortarbench.reports.document.layout import Cell, Picture, Table
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.figures.ranks import (
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
        alone = s.answers[1]
        ratios = (
            (_ONE, _ONE)
            if n == 1
            else (
                _ratio(s.speed_up(n, phase), source(alone, o), kind),
                _ratio(s.efficiency(n, phase), source(alone, o), kind),
            )
        )
        return (
            *_series(s),
            _ranks(n, kind),
            iterations_cell(o),
            Cell.number(o.counted("P_products"), "{:.0f}".format, title=source(o)),
            time,
            *ratios,
            Cell.number(o.largest("peak_mib"), "{:.0f}".format, title=source(o)),
            Cell.number(rank_memory(o), "{:.0f}".format, title=source(o)),
        )

    return Table(
        caption=TEXT("strong_caption", phase),
        columns=(
            *_SERIES,
            "ranks",
            "iterations",
            "products",
            "time",
            "speed-up",
            "efficiency",
            "peak, MiB",
            "peak of a rank, MiB",
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


def _pictures(
    strong: Sequence[StrongSeries], weak: Sequence[WeakSeries]
) -> Iterator[Picture]:
    drawn: tuple[tuple[str, Sequence[object], Callable[[], Figure]], ...] = (
        ("strong", strong, lambda: strong_figure(strong[:MOST_DRAWN])),
        ("weak", weak, lambda: weak_figure(weak[:MOST_DRAWN])),
    )
    for name, shown_series, draw in drawn:
        if shown_series:
            caption = TEXT(name, len(shown_series))
            yield Picture(name=f"ranks-{name}", caption=caption, figure=draw())
