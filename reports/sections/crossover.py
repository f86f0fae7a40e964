"""Sizes from which on dualisation pays, and all routes from the mesh to the answer."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from statistics import median

from mortarbench.harness import Record
from mortarbench.reports.data.cells import source
from mortarbench.reports.data.crossover import (
    PRIMAL,
    Crossover,
    Map,
    Route,
    Stop,
    charged,
    crossover_maps,
    memory,
)
from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.document.formatting import (
    VERDICTS,
    clean,
    estimate,
    significant,
)
from mortarbench.reports.document.layout import Cell, Part, Picture, Table
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.figures.crossover import crossover_figure
from mortarbench.reports.sections import Analysis, section
from mortarbench.reports.statistics.intervals import Interval

TEXT = Sentences(__name__)
#: parts of the time from the mesh to the answer, in chronological order
PARTS: dict[str, Callable[[Record], float]] = {
    "mesh, assembly": lambda r: (r.build_seconds or 0.0) - (r.dualise_seconds or 0.0),
    "dualisation": lambda r: r.dualise_seconds or 0.0,
    "prepare": lambda r: r.prepare_seconds or 0.0,
    "solve": lambda r: r.solve_seconds or 0.0,
    "recovery": lambda r: r.recover_seconds or 0.0,
}


@section(
    11,
    "crossover",
    "From which size on does dualisation pay?",
    "From which size on does dualisation pay?: no problem in "
    "primal and dual forms at three or more sizes (see suites/crossover.toml).",
)
def crossover(a: Analysis) -> Iterator[Part]:
    """Tabulate and draw all routes of every series of sizes."""
    maps = crossover_maps(a.evidence)
    if not maps:
        return
    yield from TEXT.parts("prose", maps, [(one.title, _answer(one)) for one in maps])
    limits = (a.evidence.suite.get(f"{kind}_limit") for kind in ("time", "memory"))
    yield Picture(
        name="crossover",
        caption=TEXT("drawn"),
        figure=crossover_figure(maps, *limits),
    )
    for one in maps:
        yield _pays_table(one)
        yield _by_size(one, "time", charged)
        yield _by_size(one, "memory", memory)
        yield _parts_table(one)
        yield _stops_table(one)


def _comparisons(one: Map) -> list[tuple[Route, Route, Crossover]]:
    """Compare every dual route with every primal one that has a common size."""
    return [
        (dual, primal, compared)
        for primal in one.routes
        for dual in one.routes
        if primal.kind in PRIMAL and dual.kind not in PRIMAL
        if (compared := one.crossover(dual, primal)) is not None
    ]


def _answer(one: Map) -> list[tuple[str, int | None, str]]:
    """Return (primal route, size, dual route): from this size (dofs) on, the dual pays.

    Each primal route has one entry, for the dual route with the smallest such size.
    Only dual routes that reach the largest size of the primal route are considered. If
    none of them pays, the size is None and the dual route is empty.
    """
    best = dict[str, tuple[str, int | None, str]]()
    for dual, primal, at in _comparisons(one):
        _, least, _ = best.setdefault(primal.label, (primal.label, None, ""))
        reaches = at.largest == max(one.routes[primal])
        if at.pays is not None and reaches and (least is None or at.pays < least):
            best[primal.label] = primal.label, at.pays, dual.label
    return list(best.values())


def _pays_table(one: Map) -> Table:
    """Tabulate all comparisons of dual routes with primal ones."""
    pairs = _comparisons(one)

    def pays(pair: tuple[Route, Route, Crossover]) -> Cell:
        at = pair[2]
        if at.pays is None:
            return Cell(text="at no common size", kind="quiet")
        first = "all common sizes, from " if at.pays == at.smallest else ""
        return Cell(text=f"{first}{at.pays}", value=at.pays)

    def ratio(pair: tuple[Route, Route, Crossover]) -> Cell:
        at = pair[2].ratio
        shown = estimate if at.pairs > 1 else lambda r: f"{significant(r[0])} [1 run]"
        return Cell.number(at, shown, title=source(*pair[2].answers))

    return Table.of(
        TEXT("pays_caption", one.title),
        pairs,
        (
            ("route", lambda p: Cell.label(p[0].label)),
            ("against", lambda p: Cell.label(p[1].label)),
            ("pays from", pays),
            ("largest common size", lambda p: Cell.number(p[2].largest)),
            ("ratio there", ratio),
            ("goes beyond", lambda p: Cell.words("yes" if p[2].beyond else "no")),
        ),
        text_columns=2,
    )


def _by_size(
    one: Map, quantity: str, measure: Callable[[Outcome], Interval | None]
) -> Table:
    def cell(route: Route, n: int) -> Cell:
        o = one.routes[route].get(n)
        if o is None:
            stop = one.stops[route]
            return Cell(text=_why(stop), kind="quiet") if n == stop.dofs else Cell()
        value = measure(o)
        shown = dict(title=source(o), after=clean(o.solver, 24))
        return (
            Cell.time(value, **shown)
            if quantity == "time"
            else Cell.number(value, _mebibytes, **shown)
        )

    rows = tuple(
        (Cell.number(n), *(cell(route, n) for route in one.routes)) for n in one.sizes
    )
    return Table(
        caption=TEXT("size_caption", quantity, one.title),
        columns=("dofs", *(route.label for route in one.routes)),
        rows=rows,
        text_columns=0,
    )


def _mebibytes(value: Interval) -> str:
    ends = f"{value.low:.0f}, {value.high:.0f}" if value.samples > 1 else "1 run"
    return f"{value.value:.0f} MiB [{ends}]"


def _parts_table(one: Map) -> Table:
    """Tabulate the parts of the time at the largest size of every route."""
    last = [(r, max(of), of[max(of)]) for r, of in one.routes.items() if of]

    def share(name: str) -> Callable[[tuple[Route, int, Outcome]], Cell]:
        return lambda each: Cell.number(
            median(PARTS[name](r) for r in each[2].records),
            lambda s: f"{significant(s)} s",
            title=source(each[2]),
        )

    return Table.of(
        TEXT("parts_caption", one.title),
        last,
        (
            ("route", lambda each: Cell.label(each[0].label)),
            ("solver", lambda each: Cell.label(each[2].solver)),
            ("dofs", lambda each: Cell.number(each[1])),
            *((name, share(name)) for name in PARTS),
        ),
        text_columns=2,
    )


def _stops_table(one: Map) -> Table:
    """Tabulate the size at which every route ends, and the reason for each solver."""

    def reasons(route: Route) -> Cell:
        ends = [
            f"{clean(o.solver, 24)}: {clean(r.message or o.verdict.words, 60)}"
            for o in one.stops[route].outcomes
            for r in [next(r for r in o.records if r.status == o.verdict)]
            if not o.verified
        ]
        return Cell.words("; ".join(ends) or "–")

    rows = [
        (
            Cell.label(route.label),
            Cell.number(max(answers, default=None)),
            Cell.number(one.stops[route].dofs),
            Cell.words(_why(one.stops[route])),
            reasons(route),
        )
        for route, answers in one.routes.items()
    ]
    for kind in one.missing:
        why = "declined by all solvers" if kind in one.declined else "not in this run"
        rows.append((Cell.label(kind), Cell(), Cell(), Cell.words(why), Cell()))
    return Table(
        caption=TEXT("stops_caption", one.title),
        columns=("route", "largest size", "ends at", "because", "solvers there"),
        rows=tuple(rows),
    )


def _why(stop: Stop) -> str:
    if stop.dofs is None:
        return "largest measured size"
    return "not measured" if stop.verdict is None else VERDICTS[stop.verdict][1]
