"""Figures as files and as part of a page, the same bytes every time."""

from __future__ import annotations

import re
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

from matplotlib import rc_context, rcParams
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from reports.figures.style import INK, STYLE

PAPER = "white"
_METADATA: dict[str, dict[str, Any]] = {".pdf": {"CreationDate": None}}
#: The style once all is in place: no figure gets a layout engine again.
_LAID_OUT: Any = STYLE | {"figure.constrained_layout.use": False}
_PAPER_IN_SVG = to_hex(PAPER)
#: Of figures that have been printed; from then on they do not change.
_BOXES: WeakKeyDictionary[Figure, Bbox] = WeakKeyDictionary()
_SVGS: WeakKeyDictionary[Figure, str] = WeakKeyDictionary()


def save(figure: Figure, path: Path) -> Path:
    """Write a figure in the format of the file's ending, the same bytes every time."""
    return save_all(figure, [path])[0]


def save_all(figure: Figure, paths: Sequence[Path]) -> list[Path]:
    """Write a figure in several formats, cut to what is drawn, which is found once."""
    for path in paths:
        if path.suffix == ".svg":
            path.write_text(_svg(figure), "utf-8", newline="\n")
        else:
            _print(figure, path, metadata=_METADATA.get(path.suffix, {}))
    return list(paths)


def inline_svg(figure: Figure, name: str) -> str:
    """Draw a figure as an <svg> element that takes its ink from the page around it.

    It is the drawing of the figure's file, without the paper and framed by the whole
    figure. Identifiers get the prefix `name`, so that several figures fit in one page.
    """
    svg, box = _svg(figure), _box(figure)
    svg = re.sub(r"<(metadata|style)\b.*?</\1>", "", svg, flags=re.DOTALL)
    width, height = (72 * float(inches) for inches in figure.get_size_inches())
    left, top = -72 * box.x0, 72 * box.y1 - height
    head = (
        f'<svg xmlns:xlink="http://www.w3.org/1999/xlink" width="{width:g}pt" '
        f'height="{height:g}pt" viewBox="{left:.6g} {top:.6g} {width:g} {height:g}" '
        'xmlns="http://www.w3.org/2000/svg" version="1.1">'
    )
    svg = head + svg[svg.index(">", svg.index("<svg")) + 1 :]
    svg = svg.replace(f"fill: {_PAPER_IN_SVG}", "fill: none", 1)
    svg = svg.replace(INK, "currentColor")
    svg = re.sub(r'\bid="', f'id="{name}-', svg)
    svg = svg.replace("url(#", f"url(#{name}-")
    return re.sub(r'href="#', f'href="#{name}-', svg)


def _svg(figure: Figure) -> str:
    """Draw a figure as an SVG file, once for its file and the page."""
    if figure not in _SVGS:
        buffer = StringIO()
        _print(figure, buffer, format="svg", metadata={"Date": None})
        _SVGS[figure] = buffer.getvalue()
    return _SVGS[figure]


def _print(figure: Figure, target: Path | StringIO, **how: Any) -> None:
    """Print a figure on paper, cut to what is drawn."""
    box = _box(figure)
    with rc_context(_LAID_OUT):
        figure.savefig(target, bbox_inches=box, facecolor=PAPER, **how)


def _box(figure: Figure) -> Bbox:
    """Place axes and legends, once for every format, and bound what is drawn, inches.

    Without a layout engine, which matplotlib would run again before each format, a
    format costs one drawing instead of two.
    """
    if figure not in _BOXES:
        with rc_context(STYLE):
            if (engine := figure.get_layout_engine()) is not None:
                engine.execute(figure)
                with rc_context(_LAID_OUT):
                    figure.set_layout_engine(None)
            canvas, pad = FigureCanvasAgg(figure), float(rcParams["savefig.pad_inches"])
            renderer = canvas.get_renderer()  # type: ignore[no-untyped-call]
            _BOXES[figure] = figure.get_tightbbox(renderer).padded(pad)
    return _BOXES[figure]
