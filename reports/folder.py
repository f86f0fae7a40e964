"""Write the report of a result folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mortarbench.harness.errors import unknown
from mortarbench.harness.record import VERIFIED_FACTOR
from mortarbench.reports.data.aggregation import ranking_of
from mortarbench.reports.data.cells import BY_OPTIMUM
from mortarbench.reports.data.comparison_groups import (
    ComparisonGroup,
    all_groups,
    answers_of,
)
from mortarbench.reports.data.environment import dateline
from mortarbench.reports.data.evidence import Evidence, read_evidence
from mortarbench.reports.data.fastest import fastest_solvers
from mortarbench.reports.data.size_series import SizeSeries, size_series, sweeps
from mortarbench.reports.data.ways import compare_ways
from mortarbench.reports.document.fields import FieldFigure
from mortarbench.reports.document.figure import Figure
from mortarbench.reports.document.formatting import TIMED, clean
from mortarbench.reports.document.layout import Page, Picture, Section
from mortarbench.reports.export.csv_tables import csv_tables, frame_csv
from mortarbench.reports.export.parquet import write_records
from mortarbench.reports.figures.scaling import MOST_SERIES, scaling_figure
from mortarbench.reports.figures.sweeps import accuracy_figure
from mortarbench.reports.render.writing import RENDERED, write_page, write_text
from mortarbench.reports.sections.answer import opening
from mortarbench.reports.sections.convergence import convergence
from mortarbench.reports.sections.performance import profiles
from mortarbench.reports.sections.physics import agreement, deformed, physics, tractions
from mortarbench.reports.sections.ranking import left_out, means, ranking
from mortarbench.reports.sections.ranks import ranks
from mortarbench.reports.sections.results import (
    claim_counts,
    claims,
    errors,
    iterations,
)
from mortarbench.reports.sections.scaling import growth, own_results, scaling, steps
from mortarbench.reports.sections.settings import cases, definitions, environment
from mortarbench.reports.sections.summary import summary
from mortarbench.reports.sections.sweeps import accuracy, certified_sweeps
from mortarbench.reports.sections.times import precision, ratios, times
from mortarbench.reports.sections.value_of_accuracy import value_of_accuracy

FORMATS = ("html", "md", "tex", "csv", "parquet")

# What sections that may be missing are called, and what they need.
_RATIOS = (
    "Ratios within blocks: every solver was measured once. repeats = 3 in the suite, "
    "or --repeats 3, gives pairs of times to compare."
)
_PRECISION = (
    "How well the times are known: the records hold no time of the canary, a fixed "
    "computation before each measurement, and the suite has no null_arm."
)
_ACCURACY = (
    "Time to accuracy: it takes the key accuracy in the suite, or answers with a "
    "certified error at three tolerances or more (see suites/accuracy.toml)."
)
_WORTH = (
    "How much accuracy was worth paying for: the errors of the meshes are not known. "
    '"mortarbench validate DIR" finds them, and a later report shows them.'
)
_CONVERGENCE = (
    "Convergence: no solver kept a history of its iterations. Those with an option "
    "history do where a suite sets it to true."
)
_AGREEMENT = "Agreement of energies: no verified answer has an energy."
_SCALING = (
    "Scaling: no cases differ in size alone, in three sizes or more (see "
    "suites/scaling.toml)."
)
_GROWTH = "Do iterations grow?: cases of four sizes or more are needed."
_STEPS = (
    "Steps of each kind against size: no solver counts anything on three sizes or more."
)
_RANKS = (
    "One solve on several ranks: nothing was verified on one rank and on several; "
    "ranks = [1, 2] in the suite (see suites/ranks.toml)."
)
_PHYSICS = "Physical results: no verified answer has physical quantities."
_DEFORMED = "Deformed bodies: no verified answer has bodies to draw."
_TRACTIONS = "Tractions along the contact: no verified answer has a contact side."


def write_report(
    directory: Path,
    formats: Sequence[str],
    factor: float = VERIFIED_FACTOR,
    *,
    pool_forms: bool = False,
) -> list[Path]:
    """Write DIR/report from DIR's journal; the same journal gives the same bytes.

    html: index.html. md: report.md. tex, csv: tables/. Figures (pdf, svg, png) go to
    figures/ along with html, md or tex. parquet: records.parquet, the journal.

    factor : verdicts are those at factor·tol; the journal's are those at 10·tol
    pool_forms : means, ranks and profiles are over the cases of all forms together

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
    written: list[Path] = []
    if rendered:
        page = compose(evidence, pool_forms=pool_forms)
        written += write_page(page, target, formats)
    if "csv" in formats:
        written += [
            write_text(target / "tables" / f"{name}.csv", frame_csv(frame))
            for name, frame in csv_tables(evidence, pool_forms=pool_forms).items()
        ]
    if "parquet" in formats:
        written.append(write_records(target / "records.parquet", evidence.journal))
    return written


def figures(
    directory: Path, factor: float = VERIFIED_FACTOR
) -> dict[str, Figure | FieldFigure]:
    """Compute the figures of the report on a folder, by the names of their files.

    factor : verdicts are those at factor·tol; the journal's are those at 10·tol

    Raises
    ------
    InputError
        For a folder that holds no measurements.

    """
    page = compose(read_evidence(directory, factor))
    pictures = (picture for section in page.sections for picture in section.pictures)
    return {picture.name: picture.figure for picture in pictures}


def answer(directory: str | Path, factor: float = VERIFIED_FACTOR) -> list[str]:
    """Return the sentences that the report of a folder opens with, a line each.

    The first one names the best way from the mesh to a verified answer over all forms;
    the others compare the solvers of each form, and name those that failed.

    factor : verdicts are those at factor·tol; the journal's are those at 10·tol

    Raises
    ------
    InputError
        For a folder that holds no measurements.

    """
    evidence = read_evidence(Path(directory), factor)
    sections = _opening(evidence, all_groups(evidence), size_series(evidence))
    return [line for s in sections for told in s.statements for line in told.lines]


def _opening(
    evidence: Evidence, groups: Sequence[ComparisonGroup], sizes: Sequence[SizeSeries]
) -> list[Section]:
    answers = answers_of(evidence)
    return opening(
        evidence,
        compare_ways(evidence),
        fastest_solvers(answers, groups),
        answers,
        certified_sweeps(evidence),
        own_results(evidence, sizes),
    )


def compose(evidence: Evidence, *, pool_forms: bool = False) -> Page:
    """Put the report together: the answer, then what it rests on.

    The answer compares ways over all forms and solvers form by form, whatever
    `pool_forms`.
    """
    found = size_series(evidence)
    groups = all_groups(evidence)
    rankings = [ranking_of(group) for group in groups if group.comparable]
    shown = all_groups(evidence, pool_forms=True) if pool_forms else groups
    left = left_out(shown, poolable=not pool_forms and _poolable(evidence, groups))
    if pool_forms:
        rankings = [ranking_of(group) for group in shown if group.comparable]
    parts = (
        *((section, "") for section in _opening(evidence, groups, found)),
        (summary(evidence), ""),
        (cases(evidence), ""),
        (claim_counts(evidence), ""),
        (claims(evidence), ""),
        (replace(times(evidence), pictures=_accuracy(evidence)), ""),
        (ratios(evidence), _RATIOS),
        (precision(evidence), _PRECISION),
        (means(rankings, left), ""),
        (ranking(rankings, left), ""),
        (profiles(rankings, evidence.solvers, left), ""),
        (accuracy(evidence), _ACCURACY),
        (value_of_accuracy(evidence), _WORTH),
        (iterations(evidence), ""),
        (convergence(evidence), _CONVERGENCE),
        (errors(evidence), ""),
        (agreement(evidence), _AGREEMENT),
        (_grown(found, evidence), _SCALING),
        (growth(found), _GROWTH),
        (steps(found, sweeps(evidence, "feti")), _STEPS),
        (ranks(evidence), _RANKS),
        (physics(evidence), _PHYSICS),
        (deformed(evidence), _DEFORMED),
        (tractions(evidence), _TRACTIONS),
        (environment(evidence), ""),
        (definitions(evidence.factor), ""),
    )
    sections = [section for section, _ in parts if section is not None]
    missing = [needs for section, needs in parts if section is None]
    sections[-2:-2] = [_absent(missing)] * bool(missing)
    return Page(
        title=clean(evidence.name),
        dateline=dateline(evidence),
        sections=tuple(sections),
        records=evidence.records,
        solvers=evidence.solvers,
    )


def _absent(missing: Sequence[str]) -> Section:
    """List the sections that the report lacks, each with what it needs."""
    return Section(
        name="absent",
        title="Not in this report",
        prose=("Sections for which there are no measurements, and what they need.",),
        points=tuple(missing),
    )


def _poolable(evidence: Evidence, groups: Sequence[ComparisonGroup]) -> bool:
    """Whether some group says nothing, and all forms together would say something."""
    if all(group.comparable for group in groups):
        return False
    pooled = all_groups(evidence, pool_forms=True)
    return len(pooled) < len(groups) and any(group.comparable for group in pooled)


def _accuracy(evidence: Evidence) -> tuple[Picture, ...]:
    figure = accuracy_figure(evidence)
    if figure is None:
        return ()
    caption = (
        "Accuracy reached against time spent, one mark per case, tolerance and solver. "
        "Filled: verified; hollow: not."
    )
    if any(o.against_residuals for o in evidence.flat):
        caption += (
            " Filled above the line, or hollow below it: decided by the proven optimum "
            f"of a small QP, against the residuals ({BY_OPTIMUM} in tables)."
        )
    return (Picture(name="accuracy", caption=caption, figure=figure),)


def _grown(found: Sequence[SizeSeries], evidence: Evidence) -> Section | None:
    """Tables and figures of every series of sizes; None where there is none."""
    section = scaling(found)
    if section is None:
        return None
    drawn = sorted(found, key=lambda series: -series.answers)[:MOST_SERIES]
    rest = (
        f" Of {len(found)} series, the {MOST_SERIES} with most answers are drawn."
        * (len(found) > MOST_SERIES)
    )
    pictures = tuple(
        Picture(
            name=f"scaling-{i}",
            caption=f"Growth of time and iterations: {series.title}. Bars: interval of "
            "the median. p: exponent of the time against n with its 95 % interval. "
            f"{TIMED}{rest}",
            figure=scaling_figure(series, evidence.solvers),
        )
        for i, series in enumerate((one for one in found if one in drawn), 1)
    )
    return replace(section, pictures=pictures)
