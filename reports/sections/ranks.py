"""One solve on several ranks: strong and weak scaling, parts, a model of the cost."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from mortarbench.reports.data.cells import source
from mortarbench.reports.data.evidence import Evidence, Outcome
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
from mortarbench.reports.document.formatting import (
    TIMED,
    bracketed,
    clean,
    plural,
    seconds,
    significant,
    span,
    tolerance,
)
from mortarbench.reports.document.layout import Cell, Picture, Section, Table, name_cell
from mortarbench.reports.figures.ranks import (
    model_figure,
    parts_figure,
    strong_figure,
    weak_figure,
)
from mortarbench.reports.statistics.cost_model import CostModel
from mortarbench.reports.statistics.intervals import Interval

MOST_DRAWN = 4  #: series of a figure; all are tabulated
MISFIT = 0.2  #: of a model that is not asked about more ranks
PREDICTED = (4, 8, 16, 32, 64, 128, 256)  #: ranks that the model is asked about
_CROWDED = "more ranks than CPUs: they took turns"
_NO_MODEL = (
    "No model of the cost: the records do not hold what the ranks sent and how fast "
    "the network was, or no more than one number of ranks had a CPU for each."
)


def ranks(evidence: Evidence) -> Section | None:
    """Tabulate and draw solves on several ranks; None where there are none."""
    strong, weak = strong_series(evidence), weak_series(evidence)
    if not strong and not weak:
        return None
    modelled = [s for s in strong if s.model is not None]
    tables = [_strong_table(strong, phase) for phase in PHASES if strong]
    tables += [_weak_table(series) for series in weak]
    tables += _part_tables(strong)
    if modelled:
        tables.append(_model_table(modelled))
    if asked := [s for s in modelled if predicted(s)]:
        tables.append(_prediction_table(asked))
    return Section(
        name="ranks",
        title="One solve on several ranks",
        prose=(*_prose(strong, weak), *([_MODEL] if modelled else [_NO_MODEL])),
        tables=tuple(tables),
        pictures=tuple(_pictures(strong, weak, modelled)),
    )


_MODEL = (
    "The model of the cost, t(N) = s·(W/N + C) + reductions + messages + bytes, is no "
    "measurement. W and C, the work that ranks share and what each does alike or waits "
    "for, are fitted to the measured times of the solve; s is how much slower copies "
    "are together than one alone; reductions, messages and bytes are counted, and take "
    "what the network was measured to take when the ranks began. Beyond the measured "
    "ranks the time of a reduction grows with the depth of a tree of ranks, a rank has "
    "up to six neighbours, and s and the bytes of a rank stay. The band is what the "
    "scatter of the repeats allows; it does not tell whether the model holds there."
)


def _prose(strong: Sequence[StrongSeries], weak: Sequence[WeakSeries]) -> list[str]:
    found = [
        "Speed-up is the time on one rank over that on N, paired within blocks and "
        "averaged by logarithms, with Student's 95 % interval; efficiency is speed-up "
        "over N. CPUs of one machine share its memory, so that N independent solves at "
        "once are not N times as fast as one either. Copies is the speed-up that they "
        "reach together; of copies is that of N ranks over it, 1 where ranks on one "
        "case do as well as independent solves."
    ]
    if any(s.several and not s.copies for s in strong):
        found.append(
            "What copies reach was not measured for all: copies = true in the suite."
        )
    if weak:
        found.append(
            "In weak scaling the case grows with the ranks, so that each has as many "
            f"degrees of freedom (within {ALIKE:.0%}). Efficiency is the time of the "
            "first case on one rank over that of a larger one on N, two samples "
            "compared by Welch's interval; of copies compares with N copies of the "
            "first case at once."
        )
    if any(s.crowded(n) for s in strong for n in s.several):
        found.append(
            "Numbers in grey are of more ranks than the machine has CPUs. Such ranks "
            "took turns; the model leaves them out."
        )
    return found


def _strong_table(found: Sequence[StrongSeries], phase: str) -> Table:
    rows = [
        (*_names(s), *_strong_row(s, n, phase)) for s in found for n in s.answers
    ]  # fmt: skip
    word = {"prepare": "Preparing", "solve": "Solving"}[phase]
    return Table(
        caption=f"{word} on ranks: strong scaling.",
        columns=(
            "case", "solver", "tol", "ranks", "iterations", "time", "speed-up",
            "efficiency", "copies", "of copies",
        ),
        rows=tuple(rows),
        text_columns=2,
        notes=(TIMED,),
    )  # fmt: skip


def _names(s: StrongSeries) -> tuple[Cell, Cell, Cell]:
    return (
        name_cell(s.case), Cell(text=clean(s.solver, 40)),
        Cell(text=tolerance(s.tol), value=s.tol),
    )  # fmt: skip


def _strong_row(s: StrongSeries, n: int, phase: str) -> tuple[Cell, ...]:
    o, kind = s.answers[n], "quiet" if s.crowded(n) else ""
    shown = [
        _count(n, kind, _CROWDED if kind else ""),
        _iterations(o),
        Cell(text=seconds(t := o.seconds(phase)), value=_value(t), title=source(o),
             kind=kind),
    ]  # fmt: skip
    if n == 1:
        return (*shown, Cell(text="1", value=1.0), Cell(text="1", value=1.0),
                Cell(), Cell())  # fmt: skip
    ratios = (s.speed_up, s.efficiency, s.reach, s.against_copies)
    copies = [s.copies[n]] if n in s.copies else []
    runs = source(s.answers[1], o), source(s.answers[1], *copies), source(o, *copies)
    titles = runs[0], runs[0], runs[1], runs[2]
    return (*shown, *(_ratio(of(n, phase), t, kind)
                      for of, t in zip(ratios, titles, strict=True)))  # fmt: skip


def _weak_table(series: WeakSeries) -> Table:
    return Table(
        caption=f"Weak scaling: {series.title}.",
        columns=(
            "ranks", "dofs", "dofs of a rank", "iterations", "prepare", "efficiency",
            "of copies", "solve", "efficiency", "of copies",
        ),
        rows=tuple(_weak_row(series, m) for m in series.members),
        text_columns=0,
        notes=(TIMED,),
    )  # fmt: skip


def _weak_row(series: WeakSeries, m: Member) -> tuple[Cell, ...]:
    o, kind = m.answer, "quiet" if series.crowded(m.ranks) else ""
    cells = [_count(m.ranks, kind, _CROWDED if kind else ""), _count(m.dofs),
             _count(m.dofs // m.ranks), _iterations(o)]  # fmt: skip
    runs = source(series.members[0].answer, o)
    for phase in PHASES:
        t = o.seconds(phase)
        cells.append(Cell(text=seconds(t), value=_value(t), title=source(o), kind=kind))
        if m.ranks == 1:
            cells += [Cell(text="1", value=1.0), Cell()]
        else:
            cells += [
                _ratio(series.efficiency(m, phase), runs, kind),
                _ratio(series.against_copies(m, phase), source(o), kind),
            ]
    return tuple(cells)


def _part_tables(found: Sequence[StrongSeries]) -> list[Table]:
    """Tabulate what ranks spent, sent and held; none where no record says so."""
    told = [(s, n, s.answers[n]) for s in found for n in s.several]
    parts = [rank_parts(o) for *_, o in told]
    counts = [rank_counts(o) for *_, o in told]
    tables = []
    if any(parts):
        named = _named(parts)
        tables.append(Table(
            caption="Seconds of the solve by part: mean of the ranks, in brackets the "
            "largest.",
            columns=("case", "solver", "tol", "ranks", "solve", *named, "rest"),
            rows=tuple(
                (*_names(s), _count(n), *_part_row(o, of, named))
                for (s, n, o), of in zip(told, parts, strict=True)
            ),
            text_columns=2,
            notes=(
                "Waiting is what a rank spends in MPI until the others' numbers have "
                "come; the rest is what is in none of the parts, as work on vectors.",
            ),
        ))  # fmt: skip
    if any(counts):
        named = _named(counts)
        tables.append(Table(
            caption="What a rank sends in a solve, and its peak memory: mean of the "
            "ranks, in brackets the largest.",
            columns=("case", "solver", "tol", "ranks", *named, "peak, MiB"),
            rows=tuple(
                (*_names(s), _count(n), *(_part(of.get(name), o) for name in named),
                 _part(rank_memory(o), o))
                for (s, n, o), of in zip(told, counts, strict=True)
            ),
            text_columns=2,
        ))  # fmt: skip
    return tables


def _named(tables: Iterable[Mapping[str, Part]]) -> list[str]:
    return list(dict.fromkeys(name for table in tables for name in table))


def _part_row(
    o: Outcome, of: Mapping[str, Part], named: Sequence[str]
) -> tuple[Cell, ...]:
    whole = _value(o.seconds("solve"))
    rest = None
    if whole is not None and of:
        rest = max(whole - sum(p.mean for p in of.values()), 0.0)
    return (
        Cell(text=significant(whole), value=whole, title=source(o)),
        *(_part(of.get(name), o) for name in named),
        Cell(text=significant(rest), value=rest),
    )


def _part(part: Part | None, o: Outcome) -> Cell:
    if part is None:
        return Cell()
    text = f"{significant(part.mean)} [{significant(part.largest)}]"
    return Cell(text=text, value=part.mean, title=source(o))


def _model_table(found: Sequence[StrongSeries]) -> Table:
    return Table(
        caption="Model of the cost of a solve, not measured: its terms on the most "
        "ranks that it is fitted to.",
        columns=(
            "case", "solver", "tol", "fitted to ranks", "W, s", "C, s", "s",
            "reductions, s", "messages, s", "bytes, s", "misfit",
            "half of N reached to N =",
        ),
        rows=tuple((*_names(s), *_model_row(s)) for s in found),
        text_columns=2,
        notes=(
            "Misfit: the largest relative difference to a measured time, 0 where two "
            f"numbers of ranks determine W and C. Above {MISFIT:.0%} the model is not "
            "asked about more ranks.",
        ),
    )  # fmt: skip


def _model_row(s: StrongSeries) -> tuple[Cell, ...]:
    m = s.model
    assert m is not None
    runs = source(*(s.answers[n] for n in m.measured))
    values = (m.work, m.alike, m.slowdown, *m.communication)
    half = m.ranks_at(0.5)
    return (
        Cell(text=", ".join(map(str, m.measured)), title=runs),
        *(Cell(text=significant(v), value=v, title=runs) for v in values),
        Cell(text=f"{m.misfit:.1%}", value=m.misfit),
        Cell(text=str(half), value=half),
    )


def _prediction_table(found: Sequence[StrongSeries]) -> Table:
    asked = sorted({n for s in found for n in predicted(s)})
    return Table(
        caption="Speed-up of a solve by the model, not measured, with the band of the "
        "fit.",
        columns=("case", "solver", "tol", *(f"N = {n}" for n in asked)),
        rows=tuple(
            (*_names(s), *(_prediction(s.model, n, predicted(s)) for n in asked))
            for s in found
        ),
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


def _prediction(model: CostModel | None, n: int, asked: Sequence[int]) -> Cell:
    if model is None or n not in asked:
        return Cell()
    return _ratio(model.speed_up(n), "model, not measured", "quiet")


def _pictures(
    strong: Sequence[StrongSeries],
    weak: Sequence[WeakSeries],
    modelled: Sequence[StrongSeries],
) -> Iterable[Picture]:
    if strong:
        yield Picture(
            name="ranks-strong",
            caption="Speed-up against ranks, preparing and solving apart; bars: 95 % "
            "intervals. Line: as many times as ranks. Hollow, dotted: what as many "
            f"independent solves reach together.{_first(strong)}",
            figure=strong_figure(strong[:MOST_DRAWN]),
        )
    told = [(s, n) for s in strong for n in s.several if rank_parts(s.answers[n])]
    if told:
        yield Picture(
            name="ranks-parts",
            caption="What ranks spend a solve on, the mean of the ranks.",
            figure=parts_figure(told[: 3 * MOST_DRAWN]),
        )
    if weak:
        yield Picture(
            name="ranks-weak",
            caption="Time where every rank has equally many degrees of freedom; level "
            "is best. Bars: interval of the median. Hollow, dotted: as many copies of "
            f"the first case at once.{_first(weak)}",
            figure=weak_figure(weak[:MOST_DRAWN]),
        )
    drawn = [s for s in modelled if predicted(s)]
    if drawn:
        yield Picture(
            name="ranks-model",
            caption="Model, not measured: speed-up of the solve on more ranks (dashed) "
            "with the band that the scatter of the repeats allows. Left of the "
            f"vertical line: measured.{_first(drawn)}",
            figure=model_figure([(s, predicted(s)) for s in drawn[:MOST_DRAWN]]),
        )


def _first(found: Sequence[object]) -> str:
    more = len(found) > MOST_DRAWN
    return f" The first {MOST_DRAWN} of {plural(len(found), 'series')}." * more


def _ratio(interval: Interval | None, title: str, kind: str) -> Cell:
    if interval is None:
        return Cell()
    one = interval.samples < 2
    text = f"{significant(interval.value)} [1 run]" if one else bracketed(*interval[:3])
    return Cell(text=text, value=interval.value, title=title, kind=kind)


def _count(n: int, kind: str = "", title: str = "") -> Cell:
    return Cell(text=str(n), value=n, kind=kind, title=title)


def _iterations(o: Outcome) -> Cell:
    its = o.iterations
    return Cell(text=span(its), value=its[0] if its else None, title=source(o))


def _value(interval: Interval | None) -> float | None:
    return None if interval is None else interval.value
