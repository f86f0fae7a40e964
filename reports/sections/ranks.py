"""One solve on several ranks: strong and weak scaling, parts, a model of the cost."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

from mortarbench.reports.data.cells import answer_columns, source
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
from mortarbench.reports.document.formatting import (
    TIMED,
    bracketed,
    seconds,
    significant,
    span,
)
from mortarbench.reports.document.layout import Cell, Column, Picture, Table, number
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.figures.ranks import (
    model_figure,
    parts_figure,
    strong_figure,
    weak_figure,
)
from mortarbench.reports.sections import Analysis, section
from mortarbench.reports.statistics.cost_model import CostModel
from mortarbench.reports.statistics.intervals import Interval

MOST_DRAWN = 4  #: series of a figure; all are tabulated
MISFIT = 0.2  #: of a model that is not asked about more ranks
PREDICTED = (4, 8, 16, 32, 64, 128, 256)  #: ranks that the model is asked about
_CROWDED = "more ranks than CPUs: they took turns"
TEXT = Sentences(__name__, ALIKE=ALIKE, MISFIT=MISFIT, MOST_DRAWN=MOST_DRAWN)

#: a series, a number of ranks, and the answer on them
Solve = tuple[StrongSeries, int, Outcome]
_ONE = Cell(text="1", value=1.0)


@section(
    66, "ranks", "One solve on several ranks",
    "One solve on several ranks: nothing was verified on one rank and on several; "
    "ranks = [1, 2] in the suite (see suites/ranks.toml).",
)  # fmt: skip
def ranks(a: Analysis) -> Iterator[layout.Part]:
    """Tabulate and draw solves on several ranks."""
    strong, weak = strong_series(a.evidence), weak_series(a.evidence)
    if not strong and not weak:
        return
    modelled = [s for s in strong if s.model is not None]
    asked = [s for s in modelled if predicted(s)]
    uncopied = any(s.several and not s.copies for s in strong)
    crowded = any(s.crowded(n) for s in strong for n in s.several)
    yield from TEXT.parts("prose", strong, weak, uncopied, crowded, modelled)
    solves = [(s, n, s.answers[n]) for s in strong for n in s.answers]
    if strong:
        yield _strong_table(solves, "prepare")
        yield _strong_table(solves, "solve")
    yield from map(_weak_table, weak)
    several = [each for each in solves if each[1] in each[0].several]
    yield from _part_tables(several)
    yield from _model_tables(modelled, asked)
    yield from _pictures(strong, weak, asked)


def _ratio(interval: Interval | None, title: str, kind: str = "") -> Cell:
    if interval is None:
        return Cell()
    one = interval.samples < 2
    text = f"{significant(interval.value)} [1 run]" if one else bracketed(*interval[:3])
    return Cell(text=text, value=interval.value, title=title, kind=kind)


def _solve(o: Outcome, phase: str, kind: str) -> Cell:
    return number(o.seconds(phase), seconds, title=source(o), kind=kind)


def _rank_count(n: int, *, crowded: bool) -> Cell:
    return number(n, kind="quiet", title=_CROWDED) if crowded else number(n)


def _iterations(o: Outcome) -> Cell:
    its = o.iterations
    return Cell(text=span(its), value=its[0] if its else None, title=source(o))


def _strong_table(solves: Sequence[Solve], phase: str) -> Table:
    def row(s: StrongSeries, n: int, o: Outcome) -> tuple[Cell, ...]:
        kind = "quiet" if s.crowded(n) else ""
        shown = (
            *(cell(s) for _, cell in answer_columns()),
            _rank_count(n, crowded=s.crowded(n)),
            _iterations(o),
            _solve(o, phase, kind),
        )
        if n == 1:
            return (*shown, _ONE, _ONE, Cell(), Cell())
        copies = [s.copies[n]] if n in s.copies else []
        alone = s.answers[1]
        return (
            *shown,
            _ratio(s.speed_up(n, phase), source(alone, o), kind),
            _ratio(s.efficiency(n, phase), source(alone, o), kind),
            _ratio(s.reach(n, phase), source(alone, *copies), kind),
            _ratio(s.against_copies(n, phase), source(o, *copies), kind),
        )

    return Table(
        caption=TEXT("strong_caption", phase),
        columns=(
            "case", "solver", "tol", "ranks", "iterations", "time", "speed-up",
            "efficiency", "copies", "of copies",
        ),
        rows=tuple(row(*each) for each in solves),
        text_columns=2,
        notes=(TIMED,),
    )  # fmt: skip


def _weak_table(series: WeakSeries) -> Table:
    first = series.members[0].answer

    def ratios(m: Member, phase: str) -> tuple[Cell, ...]:
        o, kind = m.answer, "quiet" if series.crowded(m.ranks) else ""
        time = _solve(o, phase, kind)
        if m.ranks == 1:
            return time, _ONE, Cell()
        return (
            time,
            _ratio(series.efficiency(m, phase), source(first, o), kind),
            _ratio(series.against_copies(m, phase), source(o), kind),
        )

    return Table(
        caption=f"Weak scaling: {series.title}.",
        columns=(
            "ranks", "dofs", "dofs of a rank", "iterations", "prepare", "efficiency",
            "of copies", "solve", "efficiency", "of copies",
        ),
        rows=tuple(
            (
                _rank_count(m.ranks, crowded=series.crowded(m.ranks)), number(m.dofs),
                number(m.dofs // m.ranks), _iterations(m.answer),
                *(cell for phase in PHASES for cell in ratios(m, phase)),
            )
            for m in series.members
        ),
        text_columns=0,
        notes=(TIMED,),
    )  # fmt: skip


def _part_tables(solves: Sequence[Solve]) -> Iterator[Table]:
    """Tabulate what ranks spent, sent and held; nothing where no record says so."""

    def columns(of: Callable[[Outcome], Mapping[str, Part]]) -> list[Column]:
        names = dict.fromkeys(name for _, _, o in solves for name in of(o))
        return [(name, partial(part, of, name)) for name in names]

    def part(
        of: Callable[[Outcome], Mapping[str, Part]], name: str, each: Solve
    ) -> Cell:
        return _part(of(each[2]).get(name), each[2])

    def rest(each: Solve) -> Cell:
        time, parts = each[2].seconds("solve"), rank_parts(each[2])
        if time is None or not parts:
            return Cell()
        spent = sum(part.mean for part in parts.values())
        return number(max(time.value - spent, 0.0), significant)

    def whole(each: Solve) -> Cell:
        time = each[2].seconds("solve")
        return number(time and time.value, significant, title=source(each[2]))

    ranks: Column = ("ranks", lambda each: number(each[1]))
    leading = (*answer_columns(lambda each: each[0]), ranks)
    if parts := columns(rank_parts):
        yield Table.of(
            TEXT("parts_caption"),
            solves,
            (*leading, ("solve", whole), *parts, ("rest", rest)),
            text_columns=2,
            notes=(TEXT("parts_note"),),
        )
    if counts := columns(rank_counts):
        peak: Column = ("peak, MiB", lambda each: _part(rank_memory(each[2]), each[2]))
        heads = (*leading, *counts, peak)
        yield Table.of(TEXT("sent_caption"), solves, heads, text_columns=2)


def _part(part: Part | None, o: Outcome) -> Cell:
    if part is None:
        return Cell()
    text = f"{significant(part.mean)} [{significant(part.largest)}]"
    return Cell(text=text, value=part.mean, title=source(o))


def _model_tables(
    modelled: Sequence[StrongSeries], asked: Sequence[StrongSeries]
) -> Iterator[Table]:
    """Tabulate the terms of models, and what those that fit predict."""
    models = [(s, s.model) for s in modelled if s.model is not None]
    series = answer_columns(lambda each: each[0])

    def runs(each: tuple[StrongSeries, CostModel]) -> str:
        return source(*(each[0].answers[n] for n in each[1].measured))

    def term(
        of: Callable[[CostModel], float], each: tuple[StrongSeries, CostModel]
    ) -> Cell:
        return number(of(each[1]), significant, title=runs(each))

    terms: dict[str, Callable[[CostModel], float]] = {
        "W, s": lambda m: m.work,
        "C, s": lambda m: m.alike,
        "s": lambda m: m.slowdown,
        "reductions, s": lambda m: m.communication[0],
        "messages, s": lambda m: m.communication[1],
        "bytes, s": lambda m: m.communication[2],
    }
    if models:
        yield Table.of(
            TEXT("model_caption"),
            models,
            (
                *series,
                (
                    "fitted to ranks",
                    lambda each: Cell(
                        text=", ".join(map(str, each[1].measured)), title=runs(each)
                    ),
                ),
                *((head, partial(term, of)) for head, of in terms.items()),
                ("misfit", lambda each: number(each[1].misfit, "{:.1%}".format)),
                (
                    "half of N reached to N =",
                    lambda each: number(each[1].ranks_at(0.5)),
                ),
            ),
            text_columns=2,
            notes=(TEXT("model_note"),),
        )

    def prediction(n: int, each: tuple[StrongSeries, CostModel]) -> Cell:
        if n not in predicted(each[0]):
            return Cell()
        return _ratio(each[1].speed_up(n), "model, not measured", "quiet")

    if asked:
        beyond = sorted({n for s in asked for n in predicted(s)})
        yield Table.of(
            TEXT("prediction_caption"),
            [each for each in models if each[0] in asked],
            (*series, *((f"N = {n}", partial(prediction, n)) for n in beyond)),
            text_columns=2,
            notes=("There are no more ranks than subdomains.",),
        )


def predicted(s: StrongSeries) -> tuple[int, ...]:
    """List the ranks beyond the measured ones that the model is asked about.

    Empty where it does not even fit the measured ones.
    """
    assert s.model is not None
    if s.model.misfit > MISFIT:
        return ()
    most = s.most or PREDICTED[-1]
    return tuple(n for n in PREDICTED if s.model.measured[-1] < n <= most)


def _pictures(
    strong: Sequence[StrongSeries],
    weak: Sequence[WeakSeries],
    asked: Sequence[StrongSeries],
) -> Iterator[Picture]:
    told = [(s, n) for s in strong for n in s.several if rank_parts(s.answers[n])]
    shown = [(s, predicted(s)) for s in asked[:MOST_DRAWN]]
    drawn: tuple[tuple[str, Sequence[object], Callable[[], Figure]], ...] = (
        ("strong", strong, lambda: strong_figure(strong[:MOST_DRAWN])),
        ("parts", told, lambda: parts_figure(told[: 3 * MOST_DRAWN])),
        ("weak", weak, lambda: weak_figure(weak[:MOST_DRAWN])),
        ("model", asked, lambda: model_figure(shown)),
    )
    for name, found, draw in drawn:
        if found:
            caption = TEXT(name, len(found))
            yield Picture(name=f"ranks-{name}", caption=caption, figure=draw())
