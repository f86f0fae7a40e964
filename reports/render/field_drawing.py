"""Figures of bodies, drawn with matplotlib."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from matplotlib import colormaps, patheffects, rc_context
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize, to_rgba
from matplotlib.figure import Figure as Canvas
from matplotlib.tri import Triangulation

from mortarbench.reports.document.fields import (
    Arrow,
    ColourField,
    ColourScale,
    FieldFigure,
    FieldMark,
    FieldPanel,
    Label,
    Path,
    Polygons,
    Strokes,
    Vectors,
)
from mortarbench.reports.render.drawing import STYLE, look_of

_CASING: list[patheffects.AbstractPathEffect] = [
    patheffects.withStroke(linewidth=1.6, foreground="white")
]
#: wide enough that the strokes of a letter do not show white between them
_LETTER_CASING: list[patheffects.AbstractPathEffect] = [
    patheffects.withStroke(linewidth=3.2, foreground="white")
]


def draw_fields(figure: FieldFigure) -> Canvas:
    """Draw a figure of bodies; it is laid out when it is printed."""
    with rc_context(STYLE):
        canvas = Canvas(figsize=(figure.width, figure.height))
        grid = canvas.add_gridspec(
            len(figure.heights), figure.columns, height_ratios=figure.heights
        )
        made = []
        for i, panel in enumerate(figure.panels):
            axes = canvas.add_subplot(grid[divmod(i, figure.columns)])
            _panel(axes, panel)
            made.append(axes)
            if panel.scale:
                _bar(canvas, panel.scale, axes, orientation="horizontal", aspect=30,
                     fraction=0.06, pad=0.02)  # fmt: skip
        if figure.scale:
            _bar(canvas, figure.scale, made, aspect=32, fraction=0.04, pad=0.015)
    return canvas


def _panel(axes: Axes, panel: FieldPanel) -> None:
    axes.set(
        aspect="equal", title=panel.title, xlabel=panel.xlabel, ylabel=panel.ylabel
    )
    for i, mark in enumerate(panel.marks):
        _mark(axes, mark, 1.0 + i / (1 + len(panel.marks)))
    axes.set(xlim=(panel.low[0], panel.high[0]), ylim=(panel.low[1], panel.high[1]))
    if panel.unit != 1.0:
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(_in_units(panel.unit))
    axes.tick_params(labelbottom=panel.numbered[0], labelleft=panel.numbered[1])
    if panel.axes == "none":
        axes.axis("off")
    axes.spines[["top", "right"]].set_visible(panel.axes == "frame")


def _mark(axes: Axes, mark: FieldMark, height: float) -> None:
    match mark:
        case ColourField():
            x, y = mark.points.T
            mesh = Triangulation(x, y, mark.triangles)
            axes.tripcolor(
                mesh, mark.values, cmap=mark.scale.colours, norm=_norm(mark.scale),
                shading="gouraud", rasterized=True, zorder=height,
            )  # fmt: skip
        case Polygons():
            fill = to_rgba(mark.fill, mark.opacity) if mark.fill != "none" else "none"
            polygons = PolyCollection(
                list(mark.corners), facecolor=fill, edgecolor=mark.edge,
                linewidth=mark.width, hatch=mark.hatch or None, zorder=height,
            )  # fmt: skip
            polygons.set_path_effects(_CASING if mark.cased else [])
            axes.add_collection(polygons)
        case Strokes():
            axes.add_collection(
                LineCollection(
                    list(mark.ends), color=mark.colour, linewidth=mark.width,
                    alpha=mark.opacity, rasterized=mark.rasterised, zorder=height,
                )
            )  # fmt: skip
        case Path():
            axes.plot(*mark.points.T, zorder=height, **look_of(mark.look))
        case Vectors():
            axes.quiver(
                *mark.feet.T, *mark.vectors.T, angles="xy", scale_units="xy", scale=1,
                width=mark.width, color=mark.colour, zorder=height,
                path_effects=_CASING if mark.cased else [],
            )  # fmt: skip
        case Arrow():
            arrow = {
                "arrowstyle": mark.head, "color": mark.colour, "lw": mark.width,
                "mutation_scale": mark.size, "shrinkA": mark.gap, "shrinkB": 0,
            }  # fmt: skip
            axes.annotate("", mark.end, mark.start, arrowprops=arrow, zorder=height)
        case Label():
            axes.annotate(
                mark.text, mark.place, xytext=mark.offset, color=mark.colour,
                textcoords="offset points", ha=mark.align[0], va=mark.align[1],
                path_effects=_LETTER_CASING if mark.cased else [], zorder=height,
                fontsize=mark.size,
            )  # fmt: skip


def _in_units(unit: float) -> Callable[[float, float], str]:
    """Write numbers of an axis in multiples of `unit`."""
    return lambda v, _: f"{v / unit:.4g}".replace("-", "−")


def _norm(scale: ColourScale) -> Normalize:
    return Normalize(scale.low, scale.high)


def _bar(
    canvas: Canvas, scale: ColourScale, beside: Axes | list[Axes], **how: Any
) -> None:
    colours = ScalarMappable(norm=_norm(scale), cmap=colormaps[scale.colours])
    bar = canvas.colorbar(colours, ax=beside, extend=scale.beyond, **how)
    bar.long_axis.set_major_formatter(_in_units(scale.unit))
    bar.set_label(scale.label)
    bar.outline.set_linewidth(0.5)
