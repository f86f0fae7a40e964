"""Write the report of a result folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from harness.errors import unknown
from harness.kkt import VERIFIED_FACTOR
from reports.data.aggregation import standing
from reports.data.comparison_groups import contests
from reports.data.evidence import Evidence, read_evidence
from reports.data.size_series import Ladder, ladders
from reports.document.formatting import TIMED, clean
from reports.document.layout import Page, Picture, Section
from reports.export.csv_tables import sheets
from reports.export.parquet import write_records
from reports.figures.accuracy import accuracy_figure
from reports.figures.scaling import scaling_figure
from reports.render.writing import RENDERED, write_page, write_text
from reports.sections.cases import cases
from reports.sections.claim_counts import tally
from reports.sections.convergence import convergence
from reports.sections.deformed import deformed
from reports.sections.growth import growth
from reports.sections.means import means
from reports.sections.performance import profiles
from reports.sections.physics import agreement, physics
from reports.sections.precision import precision
from reports.sections.ranking import ranking
from reports.sections.ratios import ratios
from reports.sections.results import claims, errors, iterations
from reports.sections.scaling import scaling
from reports.sections.settings import definitions, environment
from reports.sections.summary import dateline, summary
from reports.sections.sweeps import accuracy
from reports.sections.times import times
from reports.sections.value_of_accuracy import worth

MOST_LADDERS = 6  #: that are drawn; all are tabulated
FORMATS = ("html", "md", "tex", "csv", "parquet")


def write_report(
    directory: Path, formats: Sequence[str], factor: float = VERIFIED_FACTOR
) -> list[Path]:
    """Write DIR/report from DIR's journal; the same journal gives the same bytes.

    html: index.html. md: report.md. tex, csv: tables/. Figures (pdf, svg, png) go to
    figures/ along with html, md or tex. parquet: records.parquet, the journal.

    factor : verdicts are those at factor·tol; the journal's are those at 10·tol

    Raises
    ------
    InputError
        For an unknown format, or a folder that holds no measurements.

    """
    for name in formats:
        if name not in FORMATS:
            raise unknown("report format", name, FORMATS)
    evidence = read_evidence(directory, factor)
    target = directory / "report"
    rendered = RENDERED & set(formats)
    written = write_page(compose(evidence), target, formats) if rendered else []
    if "csv" in formats:
        written += [
            write_text(target / "tables" / f"{name}.csv", frame.to_csv(index=False))
            for name, frame in sheets(evidence).items()
        ]
    if "parquet" in formats:
        written.append(write_records(target / "records.parquet", evidence.journal))
    return written


def compose(evidence: Evidence) -> Page:
    """Put the report together, summary first."""
    found = ladders(evidence)
    standings = [standing(c) for c in contests(evidence)]
    sections = (
        summary(evidence),
        cases(evidence),
        tally(evidence),
        claims(evidence),
        replace(times(evidence), pictures=_accuracy(evidence)),
        ratios(evidence),
        precision(evidence),
        means(standings),
        ranking(standings),
        profiles(standings, evidence.solvers),
        accuracy(evidence),
        worth(evidence),
        iterations(evidence),
        convergence(evidence),
        errors(evidence),
        agreement(evidence),
        _grown(found, evidence),
        growth(found),
        physics(evidence),
        deformed(evidence),
        environment(evidence),
        definitions(evidence.factor),
    )
    return Page(
        title=clean(evidence.name),
        dateline=dateline(evidence),
        sections=tuple(s for s in sections if s is not None),
        records=evidence.records,
        solvers=evidence.solvers,
    )


def _accuracy(evidence: Evidence) -> tuple[Picture, ...]:
    figure = accuracy_figure(evidence)
    if figure is None:
        return ()
    caption = (
        "Accuracy reached against time spent, one mark per case, tolerance and solver. "
        "Filled: verified; hollow: not."
    )
    return (Picture(name="accuracy", caption=caption, figure=figure),)


def _grown(found: Sequence[Ladder], evidence: Evidence) -> Section | None:
    """Tables and figures of every ladder of sizes; None where there is none."""
    section = scaling(found)
    if section is None:
        return None
    drawn = sorted(found, key=lambda ladder: -ladder.answers)[:MOST_LADDERS]
    rest = (
        f" Of {len(found)} ladders, the {MOST_LADDERS} with most answers are drawn."
        * (len(found) > MOST_LADDERS)
    )
    pictures = tuple(
        Picture(
            name=f"scaling-{i}",
            caption=f"Growth of time and iterations: {ladder.title}. Bars: interval of "
            "the median. p: exponent of the time against n with its 95 % interval. "
            f"{TIMED}{rest}",
            figure=scaling_figure(ladder, evidence.solvers),
        )
        for i, ladder in enumerate((one for one in found if one in drawn), 1)
    )
    return replace(section, pictures=pictures)
