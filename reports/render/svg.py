"""An SVG drawing, as part of a page."""

from __future__ import annotations

import re
from dataclasses import dataclass

from mortarbench.reports.document.figure import INK

PAPER = "#ffffff"


@dataclass(frozen=True)
class Svg:
    """The text of an SVG file on paper, cut to what is drawn."""

    text: str
    frame: tuple[float, float, float, float]
    """Left, top, width and height of the whole figure in it, points."""


def inline(svg: Svg, name: str) -> str:
    """Make an <svg> element that takes its ink from the page around it.

    It is the drawing of the figure's file, without the paper and framed by the whole
    figure. Identifiers get the prefix `name`, so that several figures fit in one page.
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
