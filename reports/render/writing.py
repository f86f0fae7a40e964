"""Write pages, text and figures to files."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from pathlib import Path

from mortarbench.harness.files.durable import replace_file
from mortarbench.reports.document.layout import Page
from mortarbench.reports.render.html_page import html
from mortarbench.reports.render.latex import latex
from mortarbench.reports.render.markdown import markdown
from mortarbench.reports.render.svg import Svg

_NUMBERED = re.compile(r"[a-z]+-\d+\.(pdf|svg|png)")  #: files of numbered figures
RENDERED = frozenset({"html", "md", "tex"})  #: formats that contain a page


def write_page(page: Page, target: Path, formats: Collection[str]) -> list[Path]:
    """Write a page in every format of `formats` that is in `RENDERED`, with figures.

    The format html gives index.html, md gives report.md, and tex gives a file in
    tables/ for each section. The figures are written to figures/.
    """
    figures, drawings = write_figures(page, target)
    written: list[Path] = []
    if "html" in formats:
        written.append(write_text(target / "index.html", html(page, drawings)))
    if "md" in formats:
        written.append(write_text(target / "report.md", markdown(page)))
    if "tex" in formats:
        written += [
            write_text(
                target / "tables" / f"{s.name}.tex",
                latex(s.tables, s.statements, s.name),
            )
            for s in page.sections
            if s.tables or s.statements
        ]
    return written + figures


def write_text(path: Path, text: str) -> Path:
    """Write a file atomically; missing folders are created."""
    replace_file(path, text.encode())
    return path


def write_figures(page: Page, target: Path) -> tuple[list[Path], Mapping[str, Svg]]:
    """Write the figures of a page to the folder figures/ in `target`.

    Returns
    -------
    paths : list
        The files.
    drawings : mapping
        Name → content of the SVG file.

    """
    from mortarbench.reports.render.saving import (
        save_all,
    )  # imported here because it loads matplotlib

    folder = target / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    drawings: dict[str, Svg] = {}
    for picture in (p for section in page.sections for p in section.pictures):
        paths, drawings[picture.name] = save_all(picture.figure, folder, picture.name)
        written += paths
    _remove_numbered(folder, keep=written)
    return written, drawings


def _remove_numbered(folder: Path, keep: Collection[Path]) -> None:
    """Delete numbered figures of earlier reports (such as scaling-2), except `keep`."""
    for path in folder.iterdir():
        if _NUMBERED.fullmatch(path.name) and path not in keep:
            path.unlink()
