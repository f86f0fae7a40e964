"""The report as one HTML file, which neither needs nor permits network access."""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Mapping
from functools import partial
from hashlib import sha256
from importlib.resources import files
from urllib.parse import quote

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from mortarbench.reports.document.layout import Cell, Page, Picture, short
from mortarbench.reports.render.embedded import (
    Rows,
    data,
    details,
    plots,
    rows_of,
    runs_of,
)
from mortarbench.reports.render.formulas import mathml, split
from mortarbench.reports.render.svg import Svg, inline

FIRST = 50  #: number of table rows in the HTML itself; the script adds the others
SCRIPTS = ("base", "tables", "marks", "chart", "plots", "runs")
_NUMBER = re.compile(r"\b\d[\d.]*e-\d+\b")
_LEFTWARDS = re.compile(r"[\u0590-\u08ff\ufb1d-\ufdff\ufe70-\ufefc]+")
_IDENTITY = re.compile(r"\b([0-9a-f]{12}-)?[0-9a-f]{12}\b")


def html(page: Page, drawings: Mapping[str, Svg] | None = None) -> str:
    """Render the whole report; all text is escaped, figures are inline.

    The content security policy of the page allows the one embedded script, by its
    hash, and forbids every request.

    drawings : figures that are already drawn, by name
    """
    rows = rows_of(page.records)
    curves = plots(page, rows)
    code = "\n".join(_asset(f"{name}.js") for name in SCRIPTS)
    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["breakable"] = breakable
    environment.filters["prose"] = partial(prose, rows=rows)
    environment.filters["drawn"] = partial(drawn, drawings=drawings or {})
    environment.filters["link"] = partial(link, page=page, rows=rows)
    return environment.from_string(_asset("page.html.j2")).render(
        page=page,
        first=FIRST,
        plots=list(curves),
        policy=_policy(code),
        style=Markup(_asset("page.css")),
        code=Markup(code),
        data=Markup(data(page, list(curves.values()), rows)),
        details=Markup(details(page.records)),
    )


def _asset(name: str) -> str:
    return (
        files("mortarbench.reports.render").joinpath("assets", name).read_text("utf-8")
    )


def _policy(code: str) -> str:
    digest = b64encode(sha256(f"\n{code}\n".encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )


def breakable(text: str) -> Markup:
    """Allow line breaks after the slashes of case names, and none within numbers.

    Right-to-left text is isolated, so that it does not reorder the text around it.
    """
    parts = str(Markup("/<wbr>").join(text.split("/")))  # join escapes the parts
    kept = _NUMBER.sub(r'<span class="nb">\g<0></span>', parts)
    return Markup(_LEFTWARDS.sub(r"<bdi>\g<0></bdi>", kept))


def prose(text: str, rows: Rows) -> Markup:
    """Render prose with formulas as MathML, breakable names and linked identities."""

    def linked(match: re.Match[str]) -> str:
        name = match[0]
        return f'<a href="#run-{name}">{name}</a>' if name in rows else name

    parts = split(text)
    parts[::2] = [_IDENTITY.sub(linked, str(breakable(part))) for part in parts[::2]]
    for i in range(1, len(parts), 2):
        try:
            parts[i] = mathml(parts[i])
        except ValueError:  # a user's name that only looks like a formula
            parts[i] = str(breakable(rf"\({parts[i]}\)"))
    return Markup("".join(parts))


def link(cell: Cell, page: Page, rows: Rows) -> Markup:
    """Return the attributes of a link to the measurements of a cell; empty if none."""
    runs = runs_of(cell, rows)
    if not runs:
        return Markup("")
    target = quote(short(page.records[runs[0]].identity), safe="")
    return Markup(f'href="#run-{target}" data-runs="{",".join(map(str, runs))}"')


def drawn(picture: Picture, drawings: Mapping[str, Svg]) -> Markup:
    """Embed a figure as SVG; its labels are already sanitised by `legible`."""
    svg = drawings.get(picture.name)
    if svg is None:
        from mortarbench.reports.render.saving import (
            draw_svg,  # imported here because it loads matplotlib
        )

        svg = draw_svg(picture.figure)
    return Markup(inline(svg, picture.name))
