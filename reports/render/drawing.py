"""Figures of curves and of bodies, drawn with matplotlib."""

from __future__ import annotations

from collections.abc import Callable
from math import ceil, log10
from typing import Any

import numpy as np
from matplotlib import colormaps, patheffects, rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis as TickedAxis
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import (
    BoundaryNorm,
    Colormap,
    ListedColormap,
    Normalize,
    to_rgba,
)
from matplotlib.figure import Figure as Canvas
from matplotlib.figure import SubFigure
from matplotlib.lines import Line2D
from matplotlib.ticker import (
    FixedLocator,
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    NullFormatter,
    NullLocator,
)
from matplotlib.tri import Triangulation

from mortarbench.reports.document.fields import (
    Arrow,
    ColourField,
    ColourScale,
    Faces,
    FieldFigure,
    FieldMark,
    FieldPanel,
    Label,
    Path,
    Polygons,
    Raster,
    Strokes,
    Vectors,
)
from mortarbench.reports.document.figure import (
    INK,
    Area,
    Axis,
    ColourBar,
    Figure,
    Legend,
    Look,
    Mark,
    Panel,
    Segments,
    Series,
    Text,
    fitted,
)

STYLE: Any = {
    "font.family": ["STIXGeneral", "DejaVu Sans"],
    "mathtext.fontset": "stix",
    "font.size": 9.5,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.facecolor": "none",
    "axes.axisbelow": True,
    "grid.color": "#8a93a0",
    "grid.alpha": 0.3,
    "grid.linewidth": 0.4,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "figure.facecolor": "none",
    "figure.constrained_layout.use": True,
    "savefig.dpi": 220,
    "svg.hashsalt": "mortarbench",
    "svg.fonttype": "path",
    "pdf.fonttype": 42,
}
_VAST = 100.0  #: number of decades that an axis exceeds only if an answer diverged
#: distance between a legend and the curves below it, relative to the axes height
_GAP = 0.03
_FRONT = 2.0  #: zorder of the first mark; each further one is slightly higher
_PLACES: dict[str, Any] = {
    "below": "outside lower center",
    "right": "outside right upper",
    "upper left": "upper left",
}

_CASING = 1.6  #: width of the white outline of arrows and frames, points
_LETTER_CASING = (
    3.2  #: width of the white outline of letters, enough to fill their inside, points
)


def draw_curves(figure: Figure) -> Canvas:
    """Draw a figure of curves; its layout is computed when it is printed."""
    whole = fitted(figure)
    heights = [row.height for row in whole.rows]
    with rc_context(STYLE):
        canvas = Canvas(figsize=(whole.width, whole.height))
        if any(
            row.legend for row in whole.rows
        ):  # a legend of a row needs its own subfigure
            parts = canvas.subfigures(
                len(heights), 1, height_ratios=heights, squeeze=False
            )[:, 0]
            places = [(part, 0, part.add_gridspec(1, whole.columns)) for part in parts]
        else:
            grid = canvas.add_gridspec(
                len(heights), whole.columns, height_ratios=heights
            )
            places = [(canvas, i, grid) for i in range(len(heights))]
        for row, (part, line, grid) in zip(whole.rows, places, strict=True):
            column = 0
            for panel in row.panels:
                cell = grid[line, column : column + panel.span]
                draw_panel(part.add_subplot(cell), panel)
                column += panel.span
            if row.legend:
                _legend(part, row.legend)
        if whole.legend:
            _legend(canvas, whole.legend)
        if whole.title:
            canvas.suptitle(whole.title, x=0.01, ha="left", size=9.5)
        if any(panel.legend for panel in whole.panels):
            _uncover(canvas)
    return canvas


def _uncover(canvas: Canvas) -> None:
    """Raise the upper limits of axes until no curve lies behind their legends."""
    canvas.draw_without_rendering()
    for axes in canvas.axes:
        legend = axes.get_legend()
        if legend is None:
            continue
        inside = axes.transAxes.inverted()
        room = legend.get_window_extent().transformed(inside).y0 - _GAP
        places = [
            inside.transform(axes.transData.transform(line.get_xydata()))
            for line in axes.lines
        ]
        heights = np.concatenate([p[np.isfinite(p).all(axis=1), 1] for p in places])
        top = float(heights.max(initial=0.0))
        if not 0 < room < top:
            continue
        low, high = axes.get_ylim()
        if axes.get_yscale() == "log":
            axes.set_ylim(low, low * (high / low) ** (top / room))
        else:
            axes.set_ylim(low, low + (high - low) * top / room)


def draw_panel(axes: Axes, panel: Panel) -> None:
    """Draw a panel with known axis limits into axes."""
    axes.set(
        xscale="log" if panel.x.log else "linear",
        yscale="log" if panel.y.log else "linear",
        xlim=(panel.x.low, panel.x.high),
        ylim=(panel.y.low, panel.y.high),
        title=panel.title,
    )
    _axis(panel.x, axes.xaxis, across=True)
    _axis(panel.y, axes.yaxis, across=False)
    axes.spines["left"].set_visible(panel.y.line)
    if panel.grid != "none":
        axes.grid(visible=True, which="major", axis=panel.grid)
    for rule in panel.rules:
        line = axes.axvline if rule.axis == "x" else axes.axhline
        line(rule.at, zorder=1.5, **_line(rule.look))
    for i, mark in enumerate(panel.marks):
        _mark(axes, mark, _FRONT + i / (1 + len(panel.marks)))
    for text in panel.texts:
        _text(axes, text)
    if panel.legend:
        _legend(axes, panel.legend)
    if panel.bar:
        _bar(axes, panel.bar)
    axes.set(xlim=(panel.x.low, panel.x.high), ylim=(panel.y.low, panel.y.high))


def _axis(axis: Axis, ticked: TickedAxis, *, across: bool) -> None:
    """Set label and ticks."""
    if axis.bare:  # a strip: its label is at the side
        ticked.set_label_text(axis.label, rotation=0, ha="right", va="center", size=8.5)
    else:
        ticked.set_label_text(axis.label)
    if axis.ticks is not None:
        ticked.set_ticks([v for v, _ in axis.ticks], [name for _, name in axis.ticks])
        ticked.set_minor_locator(NullLocator())
    elif axis.log:
        _log_ticks(axis, ticked, across=across)
    elif axis.most is not None:
        ticked.set_major_locator(MaxNLocator(axis.most, integer=axis.integers))
    strokes, names = ("bottom", "labelbottom") if across else ("left", "labelleft")
    ticked.set_tick_params(which="both", **{strokes: axis.marked, names: axis.numbered})


def _log_ticks(axis: Axis, ticked: TickedAxis, *, across: bool) -> None:
    """Choose ticks whose labels do not overlap."""
    assert axis.low is not None
    assert axis.high is not None
    low, high = log10(axis.low), log10(axis.high)
    decades = high - low
    ticked.set_minor_formatter(NullFormatter())
    if decades > _VAST:  # matplotlib would search for ticks far beyond the ends
        exponents = range(ceil(low), ceil(high), ceil(decades / 6))
        ticked.set_major_locator(FixedLocator([10.0**k for k in exponents]))
        ticked.set_minor_locator(NullLocator())
    elif axis.most is not None:
        ticked.set_major_locator(LogLocator(numticks=axis.most))
        ticked.set_minor_locator(NullLocator())
    elif decades < 1.8:
        most = 4 if across and not axis.plain else 6
        few = MaxNLocator(most, steps=[1, 2, 2.5, 5, 10])
        ticked.set_major_locator(few if decades < 0.5 else LogLocator(subs=(1, 2, 5)))
        if axis.plain or decades < 0.5:
            ticked.set_minor_locator(NullLocator())
    if axis.plain or decades < 1.8:
        ticked.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _line(look: Look) -> dict[str, Any]:
    """Convert the look of a line to arguments of matplotlib."""
    style: Any = "none" if look.dash is None else (0, look.dash) if look.dash else "-"
    return {
        "color": look.colour,
        "linestyle": style,
        "linewidth": look.width,
        "alpha": look.opacity if look.opacity < 1 else None,
    }


def look_of(look: Look) -> dict[str, Any]:
    """Convert the look of a line and its marks to arguments of matplotlib."""
    return {
        **_line(look),
        "marker": look.marker or "none",
        "markersize": look.size,
        "markerfacecolor": look.fill or look.colour,
        "markeredgewidth": look.edge,
    }


def _mark(axes: Axes, mark: Mark, height: float) -> None:
    match mark:
        case Series():
            _series(axes, mark, height)
        case Area():
            axes.fill_between(
                mark.x,
                mark.low,
                mark.high,
                step="post" if mark.step else None,
                color=mark.colour,
                alpha=mark.opacity,
                linewidth=0,
                zorder=height,
            )
        case Segments():
            ends = np.reshape(mark.ends, (-1, 2, 2))
            lines = LineCollection(
                list(ends), color=mark.colour, linewidth=mark.width, zorder=height
            )
            axes.add_collection(lines)


def _series(axes: Axes, series: Series, height: float) -> None:
    axes.plot(
        series.x,
        series.y,
        drawstyle="steps-post" if series.step else "default",
        markevery=(0.07, 0.19) if series.few else None,
        clip_on=series.clipped,
        zorder=height,
        **look_of(series.look),
    )
    if (bars := series.intervals) is not None:
        middle = np.array(series.y if bars.along == "y" else series.x)
        down, up = middle - bars.low, np.array(bars.high) - middle
        ends = np.maximum([down, up], 0)
        x, y = (None, ends) if bars.along == "y" else (ends, None)
        axes.errorbar(
            series.x,
            series.y,
            y,
            x,
            "none",
            color=series.look.colour,
            zorder=height,
            capsize=bars.cap,
            elinewidth=bars.width,
            capthick=bars.width,
            alpha=bars.opacity,
        )


def _text(axes: Axes, text: Text) -> None:
    """Annotate a point; matplotlib omits annotations of points beyond the axes."""
    x, y = ("axes fraction" if part else "data" for part in text.inside)
    axes.annotate(
        text.text,
        text.place,
        xycoords=x if x == y else (x, y),
        xytext=text.offset,
        textcoords="offset points",
        ha=text.align[0],
        va=text.align[1],
        fontsize=text.size,
    )


def _legend(where: Axes | Canvas | SubFigure, legend: Legend) -> None:
    keys = [Line2D([], [], **look_of(key.look)) for key in legend.keys]
    where.legend(
        keys,
        [key.label for key in legend.keys],
        loc=_PLACES[legend.place],
        ncols=legend.columns,
        title=legend.title or None,
        fontsize=legend.size,
    )


def _bar(axes: Axes, bar: ColourBar) -> None:
    count = len(bar.colours)
    norm = BoundaryNorm(np.arange(0.5, count + 1), count)
    colours = ScalarMappable(norm=norm, cmap=ListedColormap(bar.colours))
    assert isinstance(axes.figure, Canvas)
    drawn = axes.figure.colorbar(colours, ax=axes, aspect=28, pad=0.02)
    drawn.set_label(bar.label)
    drawn.set_ticks(list(range(1, count + 1, max(count // 5, 1))))
    drawn.ax.tick_params(which="minor", size=0)
    drawn.outline.set_linewidth(0.5)


def draw_fields(figure: FieldFigure) -> Canvas:
    """Draw a figure of bodies; its layout is computed when it is printed."""
    with rc_context(STYLE):
        canvas = Canvas(figsize=(figure.width, figure.height))
        grid = canvas.add_gridspec(
            len(figure.heights), figure.columns, height_ratios=figure.heights
        )
        drawn = []
        for i, panel in enumerate(figure.panels):
            axes = canvas.add_subplot(grid[divmod(i, figure.columns)])
            _field_panel(axes, panel)
            drawn.append(axes)
            if panel.scale:
                _field_bar(
                    canvas,
                    panel.scale,
                    axes,
                    orientation="horizontal",
                    aspect=30,
                    fraction=0.06,
                    pad=0.02,
                )
        if figure.scale:
            _field_bar(canvas, figure.scale, drawn, aspect=32, fraction=0.04, pad=0.015)
    return canvas


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
            axes.plot(*mark.points.T, zorder=height, **look_of(mark.look))
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


def _cased(width: float, cased: bool) -> list[patheffects.AbstractPathEffect]:
    return [patheffects.withStroke(linewidth=width, foreground="white")] * cased


def _in_units(unit: float) -> Callable[[float, float], str]:
    """Return a formatter of numbers in multiples of `unit`."""
    return lambda v, _: f"{v / unit:.4g}".replace("-", "−")


def _field_bar(
    canvas: Canvas, scale: ColourScale, beside: Axes | list[Axes], **how: Any
) -> None:
    norm = Normalize(scale.low, scale.high)
    colours = ScalarMappable(norm=norm, cmap=_colour_map(scale))
    bar = canvas.colorbar(colours, ax=beside, extend=scale.beyond, **how)
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
