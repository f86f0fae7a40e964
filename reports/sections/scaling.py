"""Time and iterations against size: fitted exponents, and whether iterations grow."""

from __future__ import annotations

from collections.abc import Sequence

from reports.data.cells import source
from reports.data.evidence import Outcome
from reports.data.size_series import SIZES as SERIES
from reports.data.size_series import SizeSeries, Sweep
from reports.document.formatting import ABSENT, TIMED, clean, exponent, seconds, span
from reports.document.layout import Cell, Picture, Section, Table
from reports.figures.steps import steps_figure, torn_figure
from reports.statistics.growth import LEVEL, SIZES, Growth, growth_of
from reports.statistics.intervals import PowerLaw

#: What the sizes of a series count, wherever they are shown.
SIZES_NAMED = (
    "n: displacement components (degrees of freedom); m: dual size, the rows of "
    "equality and contact constraints."
)


def scaling(found: Sequence[SizeSeries]) -> Section | None:
    """Tabulate every series; None where there is none."""
    if not found:
        return None
    return Section(
        name="scaling",
        title="Scaling",
        prose=(
            "Verified answers only. The exponents p of t = c·nᵖ and of t = c·mᵖ are "
            "fitted by least squares on logarithms, one point (the median of the "
            "repeats) per size; the 95 % interval is Student's with two degrees of "
            "freedom fewer than sizes, exact if the logarithms scatter normally about "
            "the line. It is a statement about the sizes in the table, not beyond "
            "them. Where m grows more slowly than n, as it does for contact on a "
            "boundary, the exponent against m is the larger for the same times.",
        ),
        tables=tuple(t for series in found for t in _tables(series)),
    )


def _tables(series: SizeSeries) -> tuple[Table, Table]:
    heads = ("n", "m", *(clean(s, 40) for s in series.solvers))
    times, counts = [], []
    for n, m, row in series.sizes:
        size = (Cell(text=str(n), value=n), Cell(text=_rows(m), value=m))
        present = [row.get(s) for s in series.solvers]
        times.append((*size, *map(_time, present)))
        counts.append((*size, *map(_iterations, present)))
    for against in ("n", "m"):
        head = f"p against {against} [95 %]"
        label = (Cell(text=head, kind="total"), Cell(text="", kind="total"))
        laws = [series.time_law(s, against) for s in series.solvers]
        growth = [series.iteration_law(s, against) for s in series.solvers]
        from_runs = [source(*(o for _, o in series.curve(s))) for s in series.solvers]
        times.append((*label, *map(_exponent, laws, from_runs)))
        counts.append((*label, *map(_exponent, growth, from_runs)))
    return (
        Table(
            caption=f"Total time against size: {series.title}.",
            notes=(SIZES_NAMED, TIMED),
            columns=heads,
            rows=tuple(times),
            text_columns=0,
        ),
        Table(
            caption=f"Iterations against size: {series.title}.",
            notes=(SIZES_NAMED,),
            columns=heads,
            rows=tuple(counts),
            text_columns=0,
        ),
    )


def _rows(m: int | None) -> str:
    return ABSENT if m is None else str(m)


def _time(outcome: Outcome | None) -> Cell:
    if outcome is None:
        return Cell(text="not verified", kind="quiet")
    interval = outcome.seconds("total")
    return Cell(
        text=seconds(interval),
        title=source(outcome),
        value=interval.value if interval else None,
    )


def _iterations(outcome: Outcome | None) -> Cell:
    if outcome is None:
        return Cell(text="not verified", kind="quiet")
    its = outcome.iterations
    return Cell(text=span(its), title=source(outcome), value=its[0] if its else None)


def _exponent(law: PowerLaw | None, runs: str) -> Cell:
    if law is None:
        return Cell(text=ABSENT, kind="total", title="fewer than three verified sizes")
    return Cell(text=exponent(law), kind="total", value=law.exponent, title=runs)


def growth(found: Sequence[SizeSeries]) -> Section | None:
    """Test every series of at least four sizes; None where there is none."""
    tested = [series for series in found if len(series.sizes) >= SIZES]
    if not tested:
        return None
    return Section(
        name="growth",
        title="Do iterations grow?",
        prose=(
            "Scalable methods need as many iterations on a large problem as on a small "
            f"one. The hypothesis that they do not grow, p ≤ 0 in c·nᵖ, is tested at "
            f"{LEVEL:.0%} by Student's one-sided test of the slope on logarithms. That "
            "no growth is detected does not show that there is none: p may be as large "
            "as its upper bound (95 %, one-sided). Fewer than four sizes on which a "
            "solver is verified make no test.",
            "The time at the largest size is what the fit t = c·nᵖ says, with the 95 % "
            "interval of a further measurement; it is refused where the solver's own "
            "verified sizes end earlier, since nothing supports the law beyond them.",
        ),
        tables=tuple(map(_growth_table, tested)),
    )


def _growth_table(series: SizeSeries) -> Table:
    largest = series.sizes[-1][0]
    return Table(
        caption=f"Growth of iterations, and time at n = {largest}: {series.title}.",
        columns=(
            "solver", "sizes", "p of iterations", "p at most", "p-value",
            "iterations", f"time at n = {largest}",
        ),
        rows=tuple(_growth_row(series, s, largest) for s in series.solvers),
    )  # fmt: skip


def _growth_row(series: SizeSeries, solver: str, largest: int) -> tuple[Cell, ...]:
    curve = series.curve(solver)
    counted = [(n, sum(o.iterations) / 2) for n, o in curve if o.iterations]
    timed = [(n, t.value) for n, o in curve if (t := o.seconds("total"))]
    return (
        Cell(text=clean(solver, 40)),
        Cell(text=str(len(curve)), value=len(curve)),
        *_tested(_fit(counted)),
        _predicted(_fit(timed), largest),
    )


def _fit(points: Sequence[tuple[int, float]]) -> Growth | None:
    """Fit what is positive; None with too few sizes."""
    kept = [(n, v) for n, v in points if n > 0 and v > 0]
    if len({n for n, _ in kept}) < SIZES:
        return None
    return growth_of(*zip(*kept, strict=True))


def _tested(fit: Growth | None) -> tuple[Cell, ...]:
    if fit is None:
        few = Cell(text="too few sizes", kind="quiet")
        return (Cell(), Cell(), Cell(), few)
    p = "< 0.001" if fit.p_value < 0.001 else f"{fit.p_value:.3f}"
    return (
        Cell(text=f"{fit.exponent + 0.0:.3f}", value=fit.exponent),
        Cell(text=f"{fit.most + 0.0:.3f}", value=fit.most),
        Cell(text=p, value=fit.p_value),
        Cell(
            text="grow" if fit.grows else "no growth detected",
            kind="over" if fit.grows else "",
        ),
    )


def _predicted(fit: Growth | None, n: int) -> Cell:
    if fit is None:
        return Cell(text=ABSENT, title="fewer than four verified sizes")
    try:
        time = fit.at(n)
    except ValueError as e:
        return Cell(text="refused", kind="quiet", title=f"{e}")
    return Cell(text=seconds(time), value=time.value)


MOST_DRAWN = 8  #: pictures of counts; all are tabulated
#: what is read before other counts; the rest in a solver's own order
FIRST = ("P_products", "preconditioner_applies", "cg", "expansion", "proportioning")


def steps(found: Sequence[SizeSeries], torn: Sequence[Sweep]) -> Section | None:
    """Tabulate what solvers count, each kind apart; None where nothing is counted.

    torn : cases that differ in how finely they are torn into subdomains
    """
    tables = [t for series in found for t in _step_tables(series)]
    tables += [_torn_table(sweep) for sweep in torn]
    if not tables:
        return None
    return Section(
        name="steps",
        title="Steps of each kind against size",
        prose=(
            "What a solver says it counted: products with P, the start included, "
            "applications of a preconditioner, and for active-set methods conjugate "
            "gradient (cg), expansion and proportioning steps apart. Conditioning "
            "shows in cg; the search for the active set shows in the other two. "
            "Verified answers only, the mean of the repeats. p is the exponent of "
            "c·nᵖ with Student's 95 % interval, p at most its one-sided 95 % bound; "
            "the test is that of iterations.",
            "H/h is the largest number of cells along a side of a subdomain, m the "
            "number of multipliers.",
        ),
        tables=tuple(tables),
        pictures=_step_pictures(found, torn),
    )


def _step_pictures(
    found: Sequence[SizeSeries], torn: Sequence[Sweep]
) -> tuple[Picture, ...]:
    """Draw the counts that tables hold, those against size first."""
    drawn = [
        (f"Counts of {clean(solver, 40)} against size: {series.title}. Dashed: c·nᵖ; "
         "p with its 95 % interval", steps_figure(series, solver))
        for series in found
        for solver in series.solvers
        if len(series.curve(solver)) >= SERIES
    ] + [
        (f"Counts of {clean(s.solver, 40)} against H/h: {s.title}", torn_figure(s))
        for s in torn
    ]  # fmt: skip
    known = [(caption, figure) for caption, figure in drawn if figure is not None]
    rest = f" The first {MOST_DRAWN} of {len(known)}." * (len(known) > MOST_DRAWN)
    return tuple(
        Picture(name=f"steps-{i}", caption=f"{caption}.{rest}", figure=figure)
        for i, (caption, figure) in enumerate(known[:MOST_DRAWN], 1)
    )


def _step_tables(series: SizeSeries) -> list[Table]:
    found = []
    for solver in series.solvers:
        names = series.counts(solver)
        curve = series.curve(solver)
        if not names or len(curve) < SERIES:
            continue
        ordered = [name for name in FIRST if name in names]
        ordered += [name for name in names if name not in FIRST]
        found.append(Table(
            caption=f"Counts of {clean(solver, 40)} against size: {series.title}.",
            columns=(
                "count", *(f"n = {n}" for n, _ in curve), "p [95 %]", "p at most",
                "p-value", "growth",
            ),
            rows=tuple(_step_row(series, solver, name) for name in ordered),
        ))  # fmt: skip
    return found


def _torn_table(sweep: Sweep) -> Table:
    """Tabulate the counts of one solver against H/h."""
    answers = sweep.answers
    named = [name for name in FIRST if answers[0][1].counted(name) is not None]
    sizes = ("subdomains", "multipliers")
    return Table(
        caption=f"Counts of {clean(sweep.solver, 40)} against H/h: {sweep.title}.",
        columns=("H/h", "subdomains", "m", *named, "total time"),
        rows=tuple(
            (
                Cell(text=str(value), value=value),
                *(Cell(text=_rows(o.size(s)), value=o.size(s)) for s in sizes),
                *(_count(o, name) for name in named),
                _time(o),
            )
            for value, o in answers
        ),
        notes=(TIMED,),
        text_columns=0,
    )


def _count(o: Outcome, name: str) -> Cell:
    value = o.counted(name)
    text = ABSENT if value is None else f"{value:.4g}"
    return Cell(text=text, value=value, title=source(o))


def _step_row(series: SizeSeries, solver: str, name: str) -> tuple[Cell, ...]:
    curve = series.curve(solver)
    counted = [(n, o.counted(name) or 0.0) for n, o in curve]
    fit = _fit(counted)
    return (
        Cell(text=clean(name, 40)),
        *(_count(o, name) for _, o in curve),
        _exponent(series.count_law(solver, name), source(*(o for _, o in curve))),
        *_tested(fit)[1:],
    )
