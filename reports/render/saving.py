"""Figures as files with reproducible bytes; importing this module loads matplotlib."""

from __future__ import annotations

from io import StringIO
from pathlib import Path
from typing import Any

from matplotlib import rc_context, rcParams
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas
from matplotlib.transforms import Bbox

from mortarbench.harness import InputError
from mortarbench.reports.document.fields import FieldFigure
from mortarbench.reports.document.figure import Figure
from mortarbench.reports.render.drawing import STYLE, draw_curves, draw_fields
from mortarbench.reports.render.svg import PAPER, Svg

ENDINGS = (".pdf", ".svg", ".png")  #: suffixes of figure files
_METADATA: dict[str, dict[str, Any]] = {".pdf": {"CreationDate": None}}
#: style without a layout engine, for printing a figure that is already laid out
_LAID_OUT: Any = STYLE | {"figure.constrained_layout.use": False}


def draw(figure: Figure | FieldFigure) -> Canvas:
    """Draw a figure with matplotlib; its layout is computed when it is printed."""
    if isinstance(figure, Figure):
        return draw_curves(figure)
    return draw_fields(figure)


def save(figure: Figure | FieldFigure, path: Path) -> Canvas:
    """Write a figure in the format of the file's suffix, with reproducible bytes.

    Returns
    -------
    canvas : matplotlib's figure, as returned by `draw`

    Raises
    ------
    InputError
        If the suffix is not in `ENDINGS`.

    """
    if path.suffix not in ENDINGS:
        known = ", ".join(sorted(ENDINGS))
        raise InputError(
            f"{path}: unknown picture format {path.suffix!r}; known: {known}"
        )
    canvas = draw(figure)
    engine = canvas.get_layout_engine()
    _save(canvas, _placed(canvas), path)
    canvas.set_layout_engine(engine)  # for changes by the caller
    return canvas


def draw_svg(figure: Figure | FieldFigure) -> Svg:
    """Draw a figure as the text of an SVG file."""
    canvas = draw(figure)
    return _svg(canvas, _placed(canvas))


def save_all(
    figure: Figure | FieldFigure, folder: Path, name: str
) -> tuple[list[Path], Svg]:
    """Write a figure in every format; it is drawn and laid out once.

    Returns
    -------
    paths : list
        The files, in the order of `ENDINGS`.
    svg : Svg
        Content of the SVG file.

    """
    canvas = draw(figure)
    box = _placed(canvas)
    svg = _svg(canvas, box)
    paths = [folder / f"{name}{ending}" for ending in ENDINGS]
    for path in paths:
        _save(canvas, box, path, svg)
    return paths, svg


def _save(canvas: Canvas, box: Bbox, path: Path, svg: Svg | None = None) -> None:
    """Write a file in the format of its suffix.

    svg : content of an SVG file if already known
    """
    if path.suffix == ".svg":
        text = (svg or _svg(canvas, box)).text
        path.write_text(text, "utf-8", newline="\n")
    else:
        _print(canvas, box, path, metadata=_METADATA.get(path.suffix, {}))


def _svg(canvas: Canvas, box: Bbox) -> Svg:
    text = StringIO()
    _print(canvas, box, text, format="svg", metadata={"Date": None})
    width, height = (72 * float(inches) for inches in canvas.get_size_inches())
    frame = (-72 * box.x0, 72 * box.y1 - height, width, height)
    return Svg(text.getvalue(), frame)


def _print(canvas: Canvas, box: Bbox, target: Path | StringIO, **how: Any) -> None:
    """Write a figure on a white background, cropped to the box."""
    with rc_context(_LAID_OUT):
        canvas.savefig(target, bbox_inches=box, facecolor=PAPER, **how)


def _placed(canvas: Canvas) -> Bbox:
    """Lay out axes and legends once for all formats, and return their bounding box."""
    # matplotlib would run the layout engine again before each format, which costs a
    # second drawing; hence it is executed here and then removed.
    with rc_context(STYLE):
        if (engine := canvas.get_layout_engine()) is not None:
            engine.execute(canvas)
            with rc_context(_LAID_OUT):
                canvas.set_layout_engine(None)
        pad = float(rcParams["savefig.pad_inches"])
        renderer = FigureCanvasAgg(canvas).get_renderer()  # type: ignore[no-untyped-call]
        return canvas.get_tightbbox(renderer).padded(pad)
