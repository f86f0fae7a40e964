"""A document as one HTML page without references to other hosts."""

from __future__ import annotations

import hashlib
from base64 import b64encode
from collections.abc import Mapping
from functools import cache, partial
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup

from mortarbench.reports.document import Document, Table

_ASSETS = Path(__file__).parent / "assets"
LONG = 44  #: length of a cell from which on it may be broken into lines


def html(document: Document, drawings: Mapping[str, str]) -> str:
    """Return the page of a document.

    drawings : SVG of each picture by its name, see `reports.figures.style.embedded`
    """
    script = (_ASSETS / "page.js").read_text("utf-8")
    digest = b64encode(hashlib.sha256(script.encode()).digest()).decode()
    place = {solver: k for k, solver in enumerate(document.solvers)}
    return _template().render(
        document=document,
        drawings={name: Markup(text) for name, text in drawings.items()},
        css=Markup((_ASSETS / "page.css").read_text("utf-8")),
        script=Markup(script),
        digest=digest,
        attributes=partial(_attributes, place),
        of_row=partial(_of_row, place),
    )


@cache
def _template() -> Template:
    environment = Environment(
        loader=FileSystemLoader(_ASSETS),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    return environment.get_template("page.html.j2")


def _attributes(
    place: Mapping[str, int], table: Table, column: int, head: str, cell: str
) -> Markup:
    """Return the classes of a cell: alignment, and the solver of its column."""
    classes = ["text"] * (column < table.texts)
    if max(map(len, cell.split("\n"))) > LONG:
        classes = ["long"]
    if head in place:
        classes.append(f"solver{place[head]}")
    if cell.startswith("1 (fastest)"):
        classes.append("first")
    return _class(classes)


def _of_row(place: Mapping[str, int], table: Table, row: tuple[str, ...]) -> Markup:
    """Return the class of the solver that one of the texts of a row names."""
    named = [f"solver{place[c]}" for c in row[: max(table.texts, 1)] if c in place]
    return _class(named[:1])


def _class(names: list[str]) -> Markup:
    return Markup(f' class="{" ".join(names)}"') if names else Markup("")
