"""Write the report of a result folder."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from pathlib import Path

from mortarbench.harness.errors import unknown
from mortarbench.harness.record import VERIFIED_FACTOR
from mortarbench.reports.data.environment import dateline
from mortarbench.reports.data.evidence import Evidence, read_evidence
from mortarbench.reports.document.fields import FieldFigure
from mortarbench.reports.document.figure import Figure
from mortarbench.reports.document.formatting import clean
from mortarbench.reports.document.layout import Page
from mortarbench.reports.export.csv_tables import csv_tables, frame_csv
from mortarbench.reports.export.parquet import write_records
from mortarbench.reports.render.writing import RENDERED, write_page, write_text
from mortarbench.reports.sections import Analysis, opening, sections

FORMATS = ("html", "md", "tex", "csv", "parquet")


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
    written: list[Path] = []
    if RENDERED & set(formats):
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
    composed = opening(Analysis(read_evidence(Path(directory), factor)))
    return [line for s in composed for told in s.statements for line in told.lines]


def compose(evidence: Evidence, *, pool_forms: bool = False) -> Page:
    """Put the report together: the answer, then what it rests on.

    The answer compares ways over all forms and solvers form by form, whatever
    `pool_forms`.
    """
    collecting = gc.isenabled()
    gc.disable()  # cells hold no cycles; walking over millions of them took a third
    try:
        composed = tuple(sections(Analysis(evidence, pool_forms=pool_forms)))
    finally:
        if collecting:
            gc.enable()
    return Page(
        title=clean(evidence.name),
        dateline=dateline(evidence),
        sections=composed,
        records=evidence.records,
        solvers=evidence.solvers,
    )
