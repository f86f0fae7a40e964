"""Time and iterations against size: fitted exponents, and growth of iterations.

A suite of one solver opens with them, with condition numbers and speed-up on ranks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mortarbench.reports.data.cells import source
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.data.rank_series import strong_series
from mortarbench.reports.data.size_series import SIZES as SERIES
from mortarbench.reports.data.size_series import SizeSeries, Sweep, sweeps
from mortarbench.reports.document.formatting import (
    ABSENT,
    TIMED,
    bracketed,
    clean,
    exponent,
    plural,
    seconds,
    significant,
    span,
    tolerance,
)
from mortarbench.reports.document.layout import Cell, Picture, Section, Statement, Table
from mortarbench.reports.figures.scaling import (
    condition_numbers,
    iterations_figure,
    steps_figure,
    torn_figure,
)
from mortarbench.reports.statistics.growth import (
    PRACTICAL,
    SIZES,
    Growth,
    Trend,
    growth_of,
)
from mortarbench.reports.statistics.intervals import PowerLaw

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
            "one. The change per decade is 10ᵖ − 1 for iterations c·nᵖ, fitted by "
            "least squares on logarithms, with Student's 95 % interval. Iterations "
            f"grow where all of the interval lies above +{PRACTICAL:.0%}, fall where "
            f"it lies below −{PRACTICAL:.0%}, and are flat where it lies between the "
            "two; otherwise the sizes do not decide. Fewer than four sizes on which a "
            "solver is verified are not judged.",
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
            "solver", "sizes", "p of iterations [95 %]", "per decade [95 %]",
            "iterations", f"time at n = {largest}",
        ),
        rows=tuple(_growth_row(series, s, largest) for s in series.solvers),
    )  # fmt: skip


def _growth_row(series: SizeSeries, solver: str, largest: int) -> tuple[Cell, ...]:
    curve = series.curve(solver)
    fit = iteration_growth(series, solver)
    p = Cell() if fit is None else Cell(text=_exponent_of(fit), value=fit.exponent)
    timed = [(n, t.value) for n, o in curve if (t := o.seconds("total"))]
    return (
        Cell(text=clean(solver, 40)),
        Cell(text=str(len(curve)), value=len(curve)),
        p,
        *_judged(fit),
        _predicted(_fit(timed), largest),
    )


def iteration_growth(series: SizeSeries, solver: str) -> Growth | None:
    """Fit the iterations of one solver; None with too few verified sizes."""
    curve = series.curve(solver)
    return _fit([(n, sum(o.iterations) / 2) for n, o in curve if o.iterations])


def _fit(points: Sequence[tuple[int, float]]) -> Growth | None:
    """Fit what is positive; None with too few sizes."""
    kept = [(n, v) for n, v in points if n > 0 and v > 0]
    if len({n for n, _ in kept}) < SIZES:
        return None
    return growth_of(*zip(*kept, strict=True))


def _judged(fit: Growth | None) -> tuple[Cell, Cell]:
    """Show the change per decade, and what it allows to say."""
    if fit is None:
        return Cell(), Cell(text="too few sizes", kind="quiet")
    trend = fit.trend
    kind = {Trend.GROWS: "over", Trend.UNDECIDED: "quiet"}.get(trend, "")
    return (
        Cell(text=per_decade(fit), value=fit.per_decade[0]),
        Cell(text=trend.value, kind=kind),
    )


def _exponent_of(fit: Growth) -> str:
    p, low, high = (v + 0.0 for v in (fit.exponent, fit.low, fit.high))
    return f"{p:.3f} [{low:.3f}, {high:.3f}]"


def per_decade(fit: Growth) -> str:
    """Print the change per decade and its interval: "+4 % [-1, +9]"."""
    change, low, high = (f"{min(100 * v, 9999):+.0f}" for v in fit.per_decade)
    return f"{change} % [{low}, {high}]"


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
            "c·nᵖ with Student's 95 % interval, and growth is judged as that of "
            "iterations.",
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
                "count", *(f"n = {n}" for n, _ in curve), "p [95 %]",
                "per decade [95 %]", "growth",
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
        *_judged(fit),
    )


MOST_TOLD = 4  #: series that have a sentence of their own
_TRENDS = {
    Trend.FLAT: "stay flat",
    Trend.GROWS: "grow",
    Trend.FALLS: "fall",
    Trend.UNDECIDED: "are neither flat nor growing for sure",
}


@dataclass(frozen=True, kw_only=True)
class OwnResults:
    """Results of a suite of one solver; empty where solvers are compared."""

    statements: tuple[Statement, ...] = ()
    pictures: tuple[Picture, ...] = ()


def own_results(evidence: Evidence, sizes: Sequence[SizeSeries]) -> OwnResults:
    """Open with the growth of iterations, condition numbers and speed-up on ranks."""
    cold = {r.solver for r in evidence.records if not r.role and r.ranks == 1}
    if len(cold) != 1:
        return OwnResults()
    (solver,) = cold
    claims = [
        *_growth(solver, sizes),
        *_condition(solver, sizes),
        *_against_subdomains(evidence),
        *_speed_up(evidence),
    ]
    if not claims:
        return OwnResults()
    statement = Statement(
        subject=clean(solver, 40),
        claims=tuple(claims),
        evidence=("growth", "scaling", "steps", "ranks", "verdicts"),
    )
    figure = iterations_figure(sizes, solver)
    caption = (
        "Iterations against size, from zero on, one line for each series of cases that "
        "differ in size only."
    )
    pictures = () if figure is None else (
        Picture(name="answer", caption=caption, figure=figure),
    )  # fmt: skip
    return OwnResults(statements=(statement,), pictures=pictures)


def _growth(solver: str, sizes: Sequence[SizeSeries]) -> list[str]:
    """Judge the growth of iterations in one sentence, then series by series."""
    fits = [(s, fit) for s in sizes if (fit := iteration_growth(s, solver))]
    if not fits:
        return []
    parts = []
    for trend, words in _TRENDS.items():
        those = [(s, fit) for s, fit in fits if fit.trend is trend]
        if those:
            where = f" in {len(those)} of {len(fits)} series" * (len(fits) > 1)
            parts.append(f"{words}{where} ({_changes([fit for _, fit in those])})")
    told = [
        f"{clean(s.title)}: {_counts(s, solver)}, {per_decade(fit)} per decade."
        for s, fit in fits[: MOST_TOLD * (len(fits) > 1)]
    ]
    curves = [point for s, _ in fits for point in s.curve(solver)]
    its = [i for _, o in curves for i in o.iterations or ()]
    reach = [n for n, _ in curves]
    return [
        f"From {significant(min(reach))} to {significant(max(reach))} degrees of "
        f"freedom {clean(solver, 40)} takes {min(its)} to {max(its)} iterations, which "
        f"{', and '.join(parts)}.",
        *told,
    ]


def _changes(fits: Sequence[Growth]) -> str:
    """Print the changes per decade of n, 95 %, from the least to the largest."""
    ordered = sorted(fits, key=lambda fit: fit.exponent)
    ends = dict.fromkeys(per_decade(fit) for fit in (ordered[0], ordered[-1]))
    return f"{' to '.join(ends)} per decade"


def _counts(series: SizeSeries, solver: str) -> str:
    its = [i for _, o in series.curve(solver) if o.iterations for i in o.iterations]
    if min(its) < max(its):
        return f"{min(its)} to {max(its)} iterations"
    return f"{its[0]} iterations on {plural(len(series.curve(solver)), 'size')}"


def _condition(solver: str, sizes: Sequence[SizeSeries]) -> list[str]:
    """Give the range of every condition number along a series."""
    found = []
    for series in sizes:
        curve = [(float(n), o) for n, o in series.curve(solver)]
        ranges = [
            f"{name} {significant(min(values))} to {significant(max(values))}"
            for name, values in condition_numbers(curve).items()
        ]
        if ranges:
            found.append(f"{clean(series.title)}: {', '.join(ranges)}.")
    return found


def _against_subdomains(evidence: Evidence) -> list[str]:
    """Give iterations at the ends of a sweep of H/h."""
    found = []
    for sweep in sweeps(evidence, "feti"):
        (a, first), (b, last) = sweep.answers[0], sweep.answers[-1]
        if first.iterations and last.iterations:
            found.append(
                f"{sweep.title}: H/h = {a} takes {first.iterations[1]} iterations, "
                f"H/h = {b} takes {last.iterations[1]}."
            )
    return found


def _speed_up(evidence: Evidence) -> list[str]:
    """Give the speed-up of the solve on the most ranks that had a CPU each."""
    found = []
    for s in strong_series(evidence):
        free = [n for n in s.several if not s.crowded(n)]
        up = s.speed_up(free[-1], "solve") if free else None
        if up is not None:
            found.append(
                f"{clean(s.case)}: {free[-1]} ranks solve "
                f"{bracketed(up.value, up.low, up.high)} times as fast as one, at tol "
                f"{tolerance(s.tol)}."
            )
    return found
