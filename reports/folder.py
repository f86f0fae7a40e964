"""Report of a result folder: files, figures and opening sentences."""

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
    """Write DIR/report from the journal in DIR; equal journals give equal bytes.

    html writes index.html, md report.md, tex and csv tables/, and parquet the journal
    as records.parquet. Figures (pdf, svg, png) accompany html, md and tex in figures/.

    Parameters
    ----------
    factor : judge at factor·tol; the verdicts of the journal are those at 10·tol
    pool_forms : compute means, ranks and profiles over the cases of all forms

    Returns
    -------
    the files written

    Raises
    ------
    InputError
        If a format is unknown, or the folder contains no measurements.

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

    factor : judge at factor·tol; the verdicts of the journal are those at 10·tol

    Raises
    ------
    InputError
        If the folder contains no measurements.

    """
    page = compose(read_evidence(directory, factor))
    pictures = (picture for section in page.sections for picture in section.pictures)
    return {picture.name: picture.figure for picture in pictures}


def answer(directory: str | Path, factor: float = VERIFIED_FACTOR) -> list[str]:
    """Return the opening sentences of the report of a folder, one per line.

    The first one names the fastest combination of solver and form, from the mesh to a
    verified answer; the others compare the solvers of each form and name failures.

    factor : judge at factor·tol; the verdicts of the journal are those at 10·tol

    Raises
    ------
    InputError
        If the folder contains no measurements.

    """
    composed = opening(Analysis(read_evidence(Path(directory), factor)))
    return [line for s in composed for each in s.statements for line in each.lines]


def compose(evidence: Evidence, *, pool_forms: bool = False) -> Page:
    """Compose the report: the answer, then the evidence.

    The answer compares combinations of solver and form, and solvers within each form;
    `pool_forms` does not change it.
    """
    collecting = gc.isenabled()
    gc.disable()  # cells have no cycles; traversing millions took a third of the time
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
