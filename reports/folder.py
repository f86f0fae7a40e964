"""Report of a result folder: files, figures and opening sentences."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from mortarbench.harness.errors import unknown
from mortarbench.harness.record import VERIFIED_FACTOR
from mortarbench.reports.data.environment import by_environment, dateline
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
    """Write the report of a result folder to `directory`/report.

    The format html gives index.html and md gives report.md; tex and csv give tables in
    tables/, and parquet gives the journal as records.parquet. With html, md or tex, all
    figures are written to figures/ as PDF, SVG and PNG. Equal journals yield files with
    identical bytes.

    Parameters
    ----------
    factor : residuals of verified answers are ≤ factor·tol; the journal uses 10·tol
    pool_forms : compute means, rankings and profiles over the cases of all forms

    Returns
    -------
    paths of the files written

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
    """Return the figures of the report on a result folder by their file stems.

    factor : residuals of verified answers are ≤ factor·tol; the journal uses 10·tol

    Raises
    ------
    InputError
        If the folder contains no measurements.

    """
    page = compose(read_evidence(directory, factor))
    pictures = (picture for section in page.sections for picture in section.pictures)
    return {picture.name: picture.figure for picture in pictures}


def answer(directory: Path, factor: float = VERIFIED_FACTOR) -> list[str]:
    """Return the first sentence of the report for each environment.

    If the forms of the problems can be compared, the sentence names the combination of
    solver and form that leads fastest from the mesh to a verified answer; otherwise, it
    compares the solvers of the first form.

    factor : residuals of verified answers are ≤ factor·tol; the journal uses 10·tol

    Raises
    ------
    InputError
        If the folder contains no measurements.

    """
    opened = map(
        opening, map(Analysis, by_environment(read_evidence(directory, factor)))
    )
    said = ((s.lines[0] for part in of for s in part.statements) for of in opened)
    return [line for first in said for line in islice(first, 1)]


def compose(evidence: Evidence, *, pool_forms: bool = False) -> Page:
    """Compose the report: first the conclusions, then the evidence for them.

    If the folder contains several environments, each has its own sections.
    The conclusions compare combinations of solver and form, and the solvers within each
    form; `pool_forms` does not change these conclusions.
    """
    collecting = gc.isenabled()
    gc.disable()  # table cells form no cycles; collection took a third of the time
    parts = by_environment(evidence)
    try:
        composed = tuple(sections(*(Analysis(e, pool_forms=pool_forms) for e in parts)))
    finally:
        if collecting:
            gc.enable()
    return Page(
        title=clean(evidence.name),
        dateline=dateline(evidence),
        sections=composed,
        records=tuple(r for e in parts for r in e.records),
        solvers=evidence.solvers,
    )
