"""Figures of bodies, drawn with matplotlib."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib import colormaps, patheffects
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Colormap, ListedColormap, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from mortarbench.reports.figures.fields import (
    Arrow,
    ColourField,
    ColourScale,
    Faces,
    FieldFigure,
    FieldMark,
    FieldPanel,
    Label,
    Look,
    Path,
    Polygons,
    Raster,
    Strokes,
    Vectors,
)
from mortarbench.reports.figures.style import Drawing, styled

_CASING = 1.6  #: width of the white outline of arrows and frames, points
#: width of the white outline of letters, enough to fill their inside, points
_LETTER_CASING = 3.2


def draw_fields(figure: FieldFigure) -> Figure:
    """Draw a figure of bodies; its layout is computed when it is printed."""
    with styled():
        drawing = Drawing(figsize=(figure.width, figure.height))
        grid = drawing.add_gridspec(
            len(figure.heights), figure.columns, height_ratios=figure.heights
        )
        drawn = []
        for i, panel in enumerate(figure.panels):
            axes = drawing.add_subplot(grid[divmod(i, figure.columns)])
            _field_panel(axes, panel)
            drawn.append(axes)
            if panel.scale:
                _field_bar(
                    drawing,
                    panel.scale,
                    axes,
                    orientation="horizontal",
                    aspect=30,
                    fraction=0.06,
                    pad=0.02,
                )
        if figure.scale:
            _field_bar(
                drawing, figure.scale, drawn, aspect=32, fraction=0.04, pad=0.015
            )
    return drawing


def _field_panel(axes: Axes, panel: FieldPanel) -> None:
    axes.set(
        aspect="equal", title=panel.title, xlabel=panel.xlabel, ylabel=panel.ylabel
    )
    for i, mark in enumerate(panel.marks):
        _field_mark(axes, mark, 1.0 + i / (1 + len(panel.marks)))
    axes.set(xlim=(panel.low[0], panel.high[0]), ylim=(panel.low[1], panel.high[1]))
    if panel.unit != 1.0:
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(_in_units(panel.unit))
    axes.tick_params(labelbottom=panel.numbered[0], labelleft=panel.numbered[1])
    if panel.axes == "none":
        axes.axis("off")
    axes.spines[["top", "right"]].set_visible(panel.axes == "frame")


_OUTLINE, _SEAM = 0.3, 0.2  #: widths of lines around and within faces, points


def _field_mark(axes: Axes, mark: FieldMark, height: float) -> None:
    match mark:
        case ColourField():
            x, y = mark.points.T
            mesh = Triangulation(x, y, mark.triangles)
            axes.tripcolor(
                mesh,
                mark.values,
                cmap=_colour_map(mark.scale),
                shading="gouraud",
                norm=Normalize(mark.scale.low, mark.scale.high),
                rasterized=True,
                zorder=height,
            )
        case Raster():
            (x0, y0), (x1, y1) = mark.low, mark.high
            axes.imshow(
                mark.values.T,
                cmap=_colour_map(mark.scale),
                origin="lower",
                norm=Normalize(mark.scale.low, mark.scale.high),
                zorder=height,
                extent=(x0, x1, y0, y1),
                interpolation="nearest",
            )
        case Faces():
            outline = np.isnan(mark.values)
            values = np.where(outline, mark.scale.low, mark.values)
            norm = Normalize(mark.scale.low, mark.scale.high)
            fills = _colour_map(mark.scale)(norm(values))
            fills[outline, 3] = 0.0
            # edges in the colour of the tile close the gaps of antialiasing
            edges = np.where(outline[:, None], to_rgba("white", 0.35), fills)
            faces = PolyCollection(
                list(mark.corners),
                facecolors=fills,
                edgecolors=edges,
                linewidths=np.where(outline, _OUTLINE, _SEAM),
                rasterized=True,
                zorder=height,
            )
            axes.add_collection(faces)
        case Polygons():
            fill = to_rgba(mark.fill, mark.opacity) if mark.fill != "none" else "none"
            polygons = PolyCollection(
                list(mark.corners),
                facecolor=fill,
                edgecolor=mark.edge,
                linewidth=mark.width,
                hatch=mark.hatch or None,
                zorder=height,
            )
            polygons.set_path_effects(_cased(_CASING, mark.cased))
            axes.add_collection(polygons)
        case Strokes():
            axes.add_collection(
                LineCollection(
                    list(mark.ends),
                    color=mark.colour,
                    linewidth=mark.width,
                    alpha=mark.opacity,
                    rasterized=mark.rasterised,
                    zorder=height,
                )
            )
        case Path():
            axes.plot(*mark.points.T, zorder=height, **_look(mark.look))
        case Vectors():
            axes.quiver(
                *mark.feet.T,
                *mark.vectors.T,
                angles="xy",
                scale_units="xy",
                scale=1,
                width=mark.width,
                color=mark.colour,
                zorder=height,
                path_effects=_cased(_CASING, mark.cased),
            )
        case Arrow():
            arrow = {
                "arrowstyle": mark.head,
                "color": mark.colour,
                "lw": mark.width,
                "mutation_scale": mark.size,
                "shrinkA": mark.gap,
                "shrinkB": 0,
            }
            axes.annotate("", mark.end, mark.start, arrowprops=arrow, zorder=height)
        case Label():
            axes.annotate(
                mark.text,
                mark.place,
                xytext=mark.offset,
                color=mark.colour,
                textcoords="offset points",
                ha=mark.align[0],
                va=mark.align[1],
                path_effects=_cased(_LETTER_CASING, mark.cased),
                zorder=height,
                fontsize=mark.size,
            )


def _look(look: Look) -> dict[str, Any]:
    """Convert the look of a line and its marks to arguments of matplotlib."""
    style: Any = "none" if look.dash is None else (0, look.dash) if look.dash else "-"
    return {
        "color": look.colour,
        "linestyle": style,
        "linewidth": look.width,
        "alpha": look.opacity if look.opacity < 1 else None,
        "marker": look.marker or "none",
        "markersize": look.size,
        "markerfacecolor": look.fill or look.colour,
        "markeredgewidth": look.edge,
    }


def _cased(width: float, cased: bool) -> list[patheffects.AbstractPathEffect]:
    return [patheffects.withStroke(linewidth=width, foreground="white")] * cased


def _in_units(unit: float) -> Callable[[float, float], str]:
    """Return a formatter of numbers in multiples of `unit`."""
    return lambda v, _: f"{v / unit:.4g}".replace("-", "−")


def _field_bar(
    drawing: Figure, scale: ColourScale, beside: Axes | list[Axes], **how: Any
) -> None:
    norm = Normalize(scale.low, scale.high)
    colours = ScalarMappable(norm=norm, cmap=_colour_map(scale))
    bar = drawing.colorbar(colours, ax=beside, extend=scale.beyond, **how)
    if scale.names:
        width = (scale.high - scale.low) / len(scale.names)
        middles = scale.low + width * (np.arange(len(scale.names)) + 0.5)
        bar.set_ticks(middles.tolist(), labels=list(scale.names))
        bar.ax.tick_params(length=0)
    else:
        bar.long_axis.set_major_formatter(_in_units(scale.unit))
    bar.set_label(scale.label)
    bar.outline.set_linewidth(0.5)


def _colour_map(scale: ColourScale) -> Colormap:
    if isinstance(scale.colours, str):
        return colormaps[scale.colours]
    return ListedColormap(scale.colours)
