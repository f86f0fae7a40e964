"""SVG drawings as parts of a page."""

from __future__ import annotations

import re
from dataclasses import dataclass

from mortarbench.reports.document.figure import INK

PAPER = "#ffffff"


@dataclass(frozen=True)
class Svg:
    """Text of an SVG file with a white background, cropped to the drawing."""

    text: str
    frame: tuple[float, float, float, float]
    """Left, top, width and height of the uncropped figure, points."""


def inline(svg: Svg, name: str) -> str:
    """Return an <svg> element whose text and axes take the text colour of the page.

    The element is the drawing in the file without its background, within the frame of
    the uncropped figure. Identifiers get the prefix `name`, since they must be unique
    in a page.
    """
    text = re.sub(r"<(metadata|style)\b.*?</\1>", "", svg.text, flags=re.DOTALL)
    left, top, width, height = svg.frame
    head = (
        f'<svg xmlns:xlink="http://www.w3.org/1999/xlink" width="{width:g}pt" '
        f'height="{height:g}pt" viewBox="{left:.6g} {top:.6g} {width:g} {height:g}" '
        'xmlns="http://www.w3.org/2000/svg" version="1.1">'
    )
    text = head + text[text.index(">", text.index("<svg")) + 1 :]
    text = text.replace(f"fill: {PAPER}", "fill: none", 1)
    text = text.replace(INK, "currentColor")
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = text.replace("url(#", f"url(#{name}-")
    return re.sub(r'href="#', f'href="#{name}-', text)
