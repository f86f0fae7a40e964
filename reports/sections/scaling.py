"""Time and iterations against size: fitted exponents, and growth of iterations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

from mortarbench.reports.data.cells import iterations_cell, source
from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.data.size_series import SIZES as SERIES
from mortarbench.reports.data.size_series import SizeSeries, Sweep, sweeps
from mortarbench.reports.document.formatting import TIMED, clean, exponent, fixed
from mortarbench.reports.document.layout import Cell, Part, Picture, Table
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.figures.scaling import (
    MOST_SERIES,
    scaling_figure,
    steps_figure,
    subdomain_figure,
)
from mortarbench.reports.sections import Analysis, section
from mortarbench.reports.statistics.growth import (
    PRACTICAL,
    SIZES,
    Growth,
    Trend,
    growth_of,
)
from mortarbench.reports.statistics.intervals import PowerLaw

MOST_DRAWN = 8  #: largest number of figures of counts; all series are tabulated
#: counts that tables list first, before the other counts in the solver's order
FIRST = ("P_products", "preconditioner_applies", "cg", "expansion", "proportioning")
TEXT = Sentences(__name__, PRACTICAL=PRACTICAL)


@section(
    60,
    "scaling",
    "Scaling",
    "Scaling: no cases that differ only in size have three or more sizes (see "
    "suites/scaling.toml).",
)
def scaling(a: Analysis) -> Iterator[Part]:
    """Tabulate every series of sizes, and draw those with the most answers."""
    if a.sizes:
        yield from TEXT.parts("scaling")
    for series in a.sizes:
        yield _against_size(series, "time")
        yield _against_size(series, "iteration")
    drawn = sorted(a.sizes, key=lambda series: -series.answers)[:MOST_SERIES]
    for i, series in enumerate((one for one in a.sizes if one in drawn), 1):
        yield Picture(
            name=f"scaling-{i}",
            caption=TEXT("growth_drawn", series.title, len(a.sizes), MOST_SERIES),
            figure=scaling_figure(series, a.evidence.solvers),
        )


def _against_size(series: SizeSeries, quantity: str) -> Table:
    """Tabulate times or iterations by size, and their exponents."""
    show, law = {
        "time": (_time, series.time_law),
        "iteration": (_iterations, series.iteration_law),
    }[quantity]
    rows = [
        (Cell.number(n), Cell.number(m), *(show(row.get(s)) for s in series.solvers))
        for n, m, row in series.sizes
    ]
    runs = [source(*(o for _, o in series.curve(s))) for s in series.solvers]
    for against in ("n", "m"):
        head = Cell(text=f"p against {against} [95 %]", kind="total")
        laws = (law(s, against) for s in series.solvers)
        rows.append((head, Cell(text="", kind="total"), *map(_exponent, laws, runs)))
    return Table(
        caption=TEXT("against_size", quantity, series.title),
        notes=(TEXT("sizes"), *[TIMED] * (quantity == "time")),
        columns=("n", "m", *(clean(s, 40) for s in series.solvers)),
        rows=tuple(rows),
        text_columns=0,
    )


def _time(outcome: Outcome | None) -> Cell:
    if outcome is None:
        return Cell(text="not verified", kind="quiet")
    return Cell.time(outcome.seconds("total"), title=source(outcome))


def _iterations(outcome: Outcome | None) -> Cell:
    if outcome is None:
        return Cell(text="not verified", kind="quiet")
    return iterations_cell(outcome)


def _exponent(law: PowerLaw | None, runs: str) -> Cell:
    if law is None:
        return Cell(kind="total", title="fewer than three verified sizes")
    return Cell(text=exponent(law), kind="total", value=law.exponent, title=runs)


@section(
    62,
    "growth",
    "Do iterations grow?",
    "Do iterations grow?: the section needs cases of four or more sizes.",
)
def growth(a: Analysis) -> Iterator[Part]:
    """Judge the growth of iterations in every series of at least four sizes."""
    tested = [series for series in a.sizes if len(series.sizes) >= SIZES]
    if tested:
        yield from TEXT.parts("growth")
    yield from map(_growth_table, tested)


def _growth_table(series: SizeSeries) -> Table:
    largest = series.sizes[-1][0]
    fits = {solver: iteration_growth(series, solver) for solver in series.solvers}

    def predicted(solver: str) -> Cell:
        curve = series.curve(solver)
        fit = _fit([(n, t.value) for n, o in curve if (t := o.seconds("total"))])
        if fit is None:
            return Cell(title="fewer than four verified sizes")
        try:
            return Cell.time(fit.at(largest))
        except ValueError as e:
            return Cell(text="no prediction", kind="quiet", title=f"{e}")

    return Table.of(
        TEXT("growth_caption", largest, series.title),
        series.solvers,
        (
            ("solver", Cell.label),
            ("sizes", lambda s: Cell.number(len(series.curve(s)))),
            ("p of iterations [95 %]", lambda s: _fitted(fits[s])),
            ("per decade [95 %]", lambda s: _per_decade(fits[s])),
            ("iterations", lambda s: _trend(fits[s])),
            (f"time at n = {largest}", predicted),
        ),
    )


def iteration_growth(series: SizeSeries, solver: str) -> Growth | None:
    """Fit the growth of one solver's iterations; None if too few sizes are verified."""
    curve = series.curve(solver)
    return _fit([(n, sum(o.iterations) / 2) for n, o in curve if o.iterations])


def _fit(points: Sequence[tuple[int, float]]) -> Growth | None:
    """Fit a power law to the positive values; None if there are too few sizes."""
    kept = [(n, v) for n, v in points if n > 0 and v > 0]
    if len({n for n, _ in kept}) < SIZES:
        return None
    return growth_of(*zip(*kept, strict=True))


def _fitted(fit: Growth | None) -> Cell:
    if fit is None:
        return Cell()
    return Cell(text=fixed((fit.exponent, fit.low, fit.high)), value=fit.exponent)


def _per_decade(fit: Growth | None) -> Cell:
    return (
        Cell() if fit is None else Cell(text=per_decade(fit), value=fit.per_decade[0])
    )


def _trend(fit: Growth | None) -> Cell:
    if fit is None:
        return Cell(text="too few sizes", kind="quiet")
    kind = {Trend.GROWS: "over", Trend.UNDECIDED: "quiet"}.get(fit.trend, "")
    return Cell(text=fit.trend.value, kind=kind)


def per_decade(fit: Growth) -> str:
    """Format the change per decade and its interval: "+4 % [-1, +9]"."""
    change, low, high = (f"{min(100 * v, 9999):+.0f}" for v in fit.per_decade)
    return f"{change} % [{low}, {high}]"


@section(
    64,
    "steps",
    "Number of steps by type against size",
    "Number of steps by type against size: no solver reports counts on three or more "
    "sizes.",
)
def steps(a: Analysis) -> Iterator[Part]:
    """Tabulate and draw the counts that solvers report, against n and H/h."""
    by_subdomain = sweeps(a.evidence, "feti")
    against_size = [
        (series, solver)
        for series in a.sizes
        for solver in series.solvers
        if len(series.curve(solver)) >= SERIES
    ]
    tables = [_step_table(*each) for each in against_size if each[0].counts(each[1])]
    tables += [_subdomain_table(sweep) for sweep in by_subdomain]
    if not tables:
        return
    yield from TEXT.parts("steps")
    yield from tables
    drawn: list[tuple[Any, ...]] = [
        (steps_figure(series, solver), "n", solver, series.title)
        for series, solver in against_size
    ]
    drawn += [
        (subdomain_figure(sweep), "H/h", sweep.solver, sweep.title)
        for sweep in by_subdomain
    ]
    known = [each for each in drawn if each[0] is not None]
    for i, (figure, *names) in enumerate(known[:MOST_DRAWN], 1):
        caption = TEXT("counts_drawn", *names, len(known), MOST_DRAWN)
        yield Picture(name=f"steps-{i}", caption=caption, figure=figure)


def _step_table(series: SizeSeries, solver: str) -> Table:
    names, curve = series.counts(solver), series.curve(solver)

    def fit(name: str) -> Growth | None:
        return _fit([(n, o.counted(name) or 0.0) for n, o in curve])

    def law(name: str) -> Cell:
        return _exponent(series.count_law(solver, name), source(*(o for _, o in curve)))

    return Table.of(
        TEXT("counts_caption", "size", solver, series.title),
        sorted(
            names, key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST)
        ),
        (
            ("count", Cell.label),
            *((f"n = {n}", partial(_count, o)) for n, o in curve),
            ("p [95 %]", law),
            ("per decade [95 %]", lambda name: _per_decade(fit(name))),
            ("growth", lambda name: _trend(fit(name))),
        ),
    )


def _subdomain_table(sweep: Sweep) -> Table:
    """Tabulate those counts of one solver that are in `FIRST` against H/h."""
    named = [n for n in FIRST if sweep.answers[0][1].counted(n) is not None]
    return Table.of(
        TEXT("counts_caption", "H/h", sweep.solver, sweep.title),
        sweep.answers,
        (
            ("H/h", lambda each: Cell.number(each[0])),
            ("subdomains", lambda each: Cell.number(each[1].size("subdomains"))),
            ("m", lambda each: Cell.number(each[1].size("multipliers"))),
            *((n, lambda each, n=n: _count(each[1], n)) for n in named),
            ("total time", lambda each: _time(each[1])),
        ),
        notes=(TIMED,),
        text_columns=0,
    )


def _count(o: Outcome, name: str) -> Cell:
    return Cell.number(o.counted(name), "{:.4g}".format, title=source(o))
