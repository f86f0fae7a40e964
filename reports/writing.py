"""Files of a document: page, Markdown, tables and figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mortarbench.harness.files.durable import replace_file
from mortarbench.reports.document import Document, Picture, latex, markdown
from mortarbench.reports.figures.style import ENDINGS, embedded, save
from mortarbench.reports.page import html


def write_document(
    document: Document, target: Path, formats: Sequence[str], page: str = "index"
) -> list[Path]:
    """Write a document in some formats, its tables and its figures.

    page : stem of the HTML page
    """
    written: list[Path] = []
    drawings = {}
    pictures = [p for section in document.sections for p in section.pictures]
    for picture in pictures if {"html", "md"} & set(formats) else ():
        files, svg = draw_files(picture, target / "figures")
        written += files
        drawings[picture.name] = embedded(svg, picture.name, document.solvers)
    texts = {}
    if "html" in formats:
        texts[target / f"{page}.html"] = html(document, drawings)
    if "md" in formats:
        name = "report" if page == "index" else page
        texts[target / f"{name}.md"] = markdown(document)
    for section in document.sections:
        for table in section.tables if "csv" in formats else ():
            texts[target / "tables" / f"{table.name}.csv"] = table.csv()
        if "tex" in formats and section.tables:
            texts[target / "tables" / f"{section.name}.tex"] = latex(section.tables)
    for path, text in texts.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, text.encode())
    return [*texts, *written]


def draw_files(picture: Picture, folder: Path) -> tuple[list[Path], str]:
    """Write a picture in every format; return the files and the text of the SVG."""
    folder.mkdir(parents=True, exist_ok=True)
    figure = picture.draw()
    files = [save(figure, folder / f"{picture.name}{ending}") for ending in ENDINGS]
    return files, (folder / f"{picture.name}.svg").read_text("utf-8")
