"""Write the report of a result folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from harness import Fields, InputError
from harness.errors import unknown
from harness.kkt import VERIFIED_FACTOR
from harness.store import load_fields
from reports.cases import cases
from reports.contests import contests
from reports.conventions import standing
from reports.courses import convergence
from reports.data import Evidence, Outcome, read_evidence
from reports.figures import accuracy_figure, scaling_figure
from reports.growth import growth
from reports.layout import Page, Picture, Section
from reports.means import means
from reports.mechanics import PERCENTILE, SCALE, clipped_at, deformed_figure
from reports.parquet import write_records
from reports.performance import profiles
from reports.physics import agreement, physics
from reports.precision import precision
from reports.ranking import ranking
from reports.ratios import ratios
from reports.results import claims, errors, iterations
from reports.scaling import Ladder, ladders, scaling
from reports.setting import definitions, environment
from reports.sheets import sheets
from reports.summary import dateline, summary
from reports.sweeps import accuracy
from reports.tally import tally
from reports.times import times
from reports.wording import TIMED, clean, tolerance
from reports.worth import worth
from reports.writing import RENDERED, write_page, write_text

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


def deformed(evidence: Evidence) -> Section | None:
    """Draw the largest verified case; None where no deformed state was stored."""
    drawable = [o for o in evidence.flat if o.verified and o.first.fields]
    if not drawable:
        return None
    chosen = max(drawable, key=_importance)
    try:
        fields = load_fields(evidence.directory, chosen.first.fields or "")
        figure = deformed_figure(fields)
    except InputError as e:  # the journal alone must do
        missing = str(e).removeprefix(f"{evidence.directory}{os.sep}")
        why = f"There is no picture of {clean(chosen.case)}: {clean(missing, 200)}."
        return Section(name="deformed", title="Deformed bodies", prose=(why,))
    picture = Picture(name="deformed", caption=_caption(chosen, fields), figure=figure)
    return Section(name="deformed", title="Deformed bodies", pictures=(picture,))


def _importance(outcome: Outcome) -> tuple[float, float, float, str, str]:
    """Order by size, then load step, then accuracy; names break ties."""
    step = outcome.first.params.get("step", 0)
    size = outcome.size("dofs") or 0
    last = float(step) if isinstance(step, int | float) else 0.0
    return (size, last, -outcome.tol, outcome.first.form, outcome.solver)


def _caption(outcome: Outcome, fields: Fields) -> str:
    caption = (
        f"{clean(outcome.case)}: the largest verified case, as answered by "
        f"{clean(outcome.solver, 40)} at tol {tolerance(outcome.tol)} (run "
        f"{clean(outcome.run_ids[0], 40)}). Displacements are drawn to scale "
        f"(factor {SCALE:g})."
    )
    limits = clipped_at(fields)
    if limits is None:
        return caption
    return (
        f"{caption} Colours: patch-recovered von Mises stress, one scale for all "
        f"bodies, clipped at the {PERCENTILE:g} % quantile of the nodal values "
        f"({limits[0] / 1e9:.3g} GPa), since stresses may be singular at clamped and "
        f"loaded corners; the largest nodal value is {limits[1] / 1e9:.3g} GPa."
    )
