"""The report as one HTML file that needs no network."""

from __future__ import annotations

import re
from importlib.resources import files

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from reports.figures import inline_svg
from reports.layout import Page, Picture

_NUMBER = re.compile(r"\b\d[\d.]*e-\d+\b")


def html(page: Page) -> str:
    """Render the whole report; all text is escaped, figures are inline."""
    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["breakable"] = breakable
    environment.filters["drawn"] = drawn
    template = files("reports").joinpath("page.html.j2").read_text("utf-8")
    return environment.from_string(template).render(page=page)


def breakable(text: str) -> Markup:
    """Allow a line break after every slash of a case name, and none within 1e-8."""
    parts = str(Markup("/<wbr>").join(text.split("/")))  # which escapes them
    return Markup(_NUMBER.sub(r'<span class="nb">\g<0></span>', parts))


def drawn(picture: Picture) -> Markup:
    """Embed a figure; its text was made by us from names that `legible` has cleaned."""
    return Markup(inline_svg(picture.figure, picture.name))
