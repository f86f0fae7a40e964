"""Time and iterations against size, with fitted exponents."""

from __future__ import annotations

from collections.abc import Sequence

from reports.data.evidence import Outcome
from reports.data.size_series import SizeSeries
from reports.document.formatting import ABSENT, TIMED, clean, exponent, seconds, span
from reports.document.layout import Cell, Section, Table
from reports.sections.cells import source
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
