"""The report of a result folder: its files, and the sentences of its first screen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from mortarbench.harness.errors import InputError, unknown
from mortarbench.harness.record import VERIFIED_FACTOR
from mortarbench.reports.export.records import plain, write_csv, write_parquet
from mortarbench.reports.figures.curves import against
from mortarbench.reports.measurements import Measurements, read_measurements
from mortarbench.reports.sections import compose
from mortarbench.reports.sections.solvers import tightest
from mortarbench.reports.writing import write_document

FORMATS = ("html", "md", "tex", "csv", "parquet")


def write_report(
    directory: Path, formats: Sequence[str], factor: float = VERIFIED_FACTOR
) -> tuple[list[Path], list[str]]:
    """Write the report of a result folder to `directory`/report.

    factor : residuals of verified answers are ≤ factor·tol; the journal uses 10·tol

    Returns
    -------
    paths of the files written, and the sentences of the first screen: one for each
    form and machine

    Raises
    ------
    InputError
        If a format is unknown, or the folder contains no measurements.

    """
    for name in formats:
        if name not in FORMATS:
            raise unknown("report format", name, FORMATS)
    run = read_measurements(directory, factor)
    target = directory / "report"
    written: list[Path] = []
    document = compose(run)
    if {"html", "md", "tex", "csv"} & set(formats):
        written += write_document(document, target, formats)
    if {"csv", "parquet"} & set(formats):
        stored = run if factor == VERIFIED_FACTOR else read_measurements(directory)
        frame = plain(stored.df)
        if "csv" in formats:
            written.append(write_csv(target / "tables" / "measurements.csv", frame))
        if "parquet" in formats:
            written.append(write_parquet(target / "records.parquet", frame))
    answers = [part for part in document.sections if part.name.startswith("answer")]
    said = [item for part in answers for item in part.items if isinstance(item, str)]
    return written, said


def plot(run: Measurements, kind: str, x: str | None = None) -> Figure:
    """Draw the figure of the report with the name `kind`.

    x : size on the horizontal axis of "scaling" and "iterations": m, n, or a key

    Raises
    ------
    InputError
        If there is no such figure, or no such size.

    """
    if x is not None:
        return _against(run, kind, x)
    pictures = {
        picture.name: picture
        for section in compose(run).sections
        for picture in section.pictures
    }
    if kind not in pictures:
        raise unknown("figure", str(kind), pictures, where=str(run.folder))
    return pictures[kind].draw()


def _against(run: Measurements, kind: str, x: str) -> Figure:
    y = {"scaling": "total_seconds", "iterations": "iterations"}
    if kind not in y:
        raise InputError(
            f"x = {x}: the figure {kind} has no x; expected {', '.join(y)}"
        )
    answers = tightest(run.answers)
    answers = answers[answers.verified]
    if x not in answers:
        values = [p.get(x) if isinstance(p, Mapping) else None for p in answers.params]
        answers = answers.assign(**{x: pd.to_numeric(values, errors="coerce")})
    figure = against(answers, run.solvers, x, y[kind])
    if figure is None:
        raise InputError(f"x = {x}: fewer than two values; expected m, n or a key")
    return figure
