"""Figures of bodies to scale, as data: meshes, coloured fields, arrows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector
from mortarbench.reports.figures.style import INK, WIDTH

Points = NDArray[np.float64]  #: (n, 2)
Numbers = tuple[float, ...]
#: distance between bodies and the ends of an axis, relative to the size of the bodies
MARGIN = 0.05


@dataclass(frozen=True, kw_only=True)
class Look:
    """Appearance of a line and its marks; widths and sizes are in points."""

    colour: str
    marker: str = ""  #: one of "o s ^ D v P X < > x + * _ |", or empty for none
    dash: Numbers | None = ()  #: dashes and gaps in line widths; None for no line
    width: float = 1.1
    size: float = 4.5  #: size of the marks
    edge: float = 1.0  #: width of the outline of marks
    fill: str = ""  #: colour within marks, "none" for hollow ones, empty for `colour`
    opacity: float = 1.0


@dataclass(frozen=True, kw_only=True)
class ColourScale:
    """Colour map of a range of values, with the label of its bar."""

    #: name of a matplotlib colour map, or colours of the classes 0, 1, … in `names`
    colours: str | tuple[str, ...]
    low: float
    high: float
    label: str = ""
    unit: float = 1.0  #: value that the bar labels as 1
    #: ends of the range beyond which values occur; the bar has triangles at these ends
    beyond: Literal["neither", "max", "both"] = "neither"
    names: tuple[str, ...] = ()  #: names of the classes, shown beside the colour bar


@dataclass(frozen=True, eq=False, kw_only=True)
class ColourField:
    """Nodal values as colours, linear within triangles."""

    points: Points
    triangles: NDArray[np.int64]  #: (t, 3)
    values: Vector  #: (n,)
    scale: ColourScale


@dataclass(frozen=True, eq=False, kw_only=True)
class Raster:
    """Values of square grid cells as colours; cells with NaN stay blank."""

    low: tuple[float, float]  #: lower left corner
    high: tuple[float, float]
    values: NDArray[np.float64]  #: (rows along x, columns along y)
    scale: ColourScale


@dataclass(frozen=True, eq=False, kw_only=True)
class Faces:
    """Quadrilaterals drawn back to front; for the value NaN, only the outline."""

    corners: NDArray[np.float64]  #: (k, 4, 2), back to front
    values: Vector  #: (k,) colours; NaN: a thin white outline
    scale: ColourScale


@dataclass(frozen=True, eq=False, kw_only=True)
class Polygons:
    """Closed polygons with fill, hatching and outline."""

    corners: tuple[Points, ...]
    fill: str = "none"
    opacity: float = 1.0  #: opacity of the fill
    edge: str = "none"
    width: float = 0.0  #: width of the edge, points
    hatch: str = ""
    cased: bool = False  #: True for a white outline around the edge


@dataclass(frozen=True, eq=False, kw_only=True)
class Strokes:
    """Straight line segments."""

    ends: NDArray[np.float64]  #: (k, 2, 2) coordinates of both ends of each segment
    colour: str
    width: float
    opacity: float = 1.0
    rasterised: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class Path:
    """Points connected by a line, drawn as marks, or both."""

    points: Points
    look: Look


@dataclass(frozen=True, eq=False, kw_only=True)
class Vectors:
    """Arrows of a vector field; their lengths are in units of the axes."""

    feet: Points
    vectors: Points
    colour: str
    width: float  #: width of the shafts, relative to the panel
    cased: bool = False


@dataclass(frozen=True, kw_only=True)
class Arrow:
    """An arrow with one of matplotlib's arrow styles."""

    start: tuple[float, float]
    end: tuple[float, float]
    head: Literal["->", "<->", "-|>", "-"] = "->"
    colour: str = INK
    width: float = 0.7
    size: float = 9.5  #: size of the head
    gap: float = 0.0  #: distance between the start and the line, points


@dataclass(frozen=True, kw_only=True)
class Label:
    """A text at a point."""

    text: str
    place: tuple[float, float]
    align: tuple[str, str] = ("left", "center")
    offset: tuple[float, float] = (0.0, 0.0)  #: points
    colour: str = INK
    cased: bool = False
    size: float = 9.5  #: points


FieldMark = (
    ColourField | Raster | Faces | Polygons | Strokes | Path | Vectors | Arrow | Label
)


@dataclass(frozen=True, eq=False, kw_only=True)
class FieldPanel:
    """Panel with bodies to scale, whose marks are drawn back to front."""

    low: tuple[float, float]  #: lower left corner
    high: tuple[float, float]
    marks: tuple[FieldMark, ...]
    title: str = ""
    xlabel: str = ""
    ylabel: str = ""
    unit: float = 1.0  #: length that the axes label as 1
    numbered: tuple[bool, bool] = (True, True)  #: True for tick labels, on x and y
    axes: Literal["lines", "frame", "none"] = "lines"
    scale: ColourScale | None = None  #: shown as a bar below the panel


@dataclass(frozen=True, eq=False, kw_only=True)
class FieldFigure:
    """Grid of panels with bodies to scale."""

    panels: tuple[FieldPanel, ...]
    height: float  #: height of the figure, inches
    width: float = WIDTH
    columns: int = 1
    heights: Numbers = (1.0,)  #: relative heights of the rows
    #: common colour scale of all panels, shown as a bar beside the panels, or None
    scale: ColourScale | None = None


def box(*bodies: Points) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return corners (lower left, upper right) of a box with margin around bodies."""
    points = np.vstack(bodies)
    low, high = points.min(axis=0), points.max(axis=0)
    pad = MARGIN * (high - low)
    (x0, y0), (x1, y1) = (low - pad).tolist(), (high + pad).tolist()
    return (x0, y0), (x1, y1)
