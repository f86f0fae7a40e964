"""The paper's figures and tables from measured data: no measuring happens here."""

from __future__ import annotations

from pathlib import Path

from mortarbench.harness.files.experiment import load_experiment
from mortarbench.reports.data.evidence import read_evidence
from mortarbench.reports.export.csv_tables import csv_tables as report_tables
from mortarbench.reports.export.csv_tables import frame_csv
from mortarbench.reports.paper.csv_tables import csv_tables
from mortarbench.reports.paper.page import BEYOND, compose
from mortarbench.reports.render.html_page import html
from mortarbench.reports.render.latex import latex
from mortarbench.reports.render.writing import write_figures, write_text


def write_paper(folder: Path) -> list[Path]:
    """Write index.html, figures/ (pdf, svg, png) and tables/ (csv, tex) from data/.

    data/ is an experiment and, where measured, the result folders of the suites of
    `BEYOND`. The same data give the same bytes.

    Raises
    ------
    InputError
        When data/ is missing or damaged.

    """
    experiment = load_experiment(folder / "data")
    suites = {
        name: read_evidence(folder / "data" / name)
        for name in BEYOND
        if (folder / "data" / name).is_dir()
    }
    page = compose(experiment, suites)
    figures, drawings = write_figures(page, folder)
    tables = folder / "tables"
    written = [write_text(folder / "index.html", html(page, drawings)), *figures]
    written += [
        write_text(
            tables / f"{section.name}.tex", latex(section.tables, name=section.name)
        )
        for section in page.sections
        if section.tables
    ]
    frames = csv_tables(experiment)
    frames |= {name: report_tables(e)["outcomes"] for name, e in suites.items()}
    written += [
        write_text(tables / f"{name}.csv", frame_csv(frame))
        for name, frame in frames.items()
    ]
    return written
