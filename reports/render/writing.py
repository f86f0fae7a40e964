"""Put a page into files."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from harness.files.durable import replace_file
from reports.document.layout import Page
from reports.figures.saving import save_all
from reports.render.html_page import html
from reports.render.latex import latex
from reports.render.markdown import markdown

ENDINGS = (".pdf", ".svg", ".png")  #: formats of figures
RENDERED = frozenset({"html", "md", "tex"})  #: formats that show a page


def write_page(page: Page, target: Path, formats: Collection[str]) -> list[Path]:
    """Write a page in those of the formats that show one, and its figures.

    html: index.html. md: report.md. tex: tables/SECTION.tex. Figures go to figures/.
    """
    written: list[Path] = []
    if "html" in formats:
        written.append(write_text(target / "index.html", html(page)))
    if "md" in formats:
        written.append(write_text(target / "report.md", markdown(page)))
    if "tex" in formats:
        written += [
            write_text(
                target / "tables" / f"{s.name}.tex", latex(s.tables, s.statements)
            )
            for s in page.sections
            if s.tables or s.statements
        ]
    return written + write_figures(page, target)


def write_text(path: Path, text: str) -> Path:
    """Write a file whole or not at all; folders are made."""
    replace_file(path, text.encode())
    return path


def write_figures(page: Page, target: Path) -> list[Path]:
    """Write the figures of a page to the folder figures/ in `target`."""
    folder = target / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    pictures = [p for section in page.sections for p in section.pictures]
    return [
        path
        for p in pictures
        for path in save_all(p.figure, [folder / f"{p.name}{e}" for e in ENDINGS])
    ]
