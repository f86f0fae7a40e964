"""Figures as data: panels of points, intervals, areas and texts.

A `Figure` contains curves; it is drawn to files (`reports.render.drawing`) and by the
interactive page (`reports.render.plots`). A `FieldFigure` shows bodies to scale; it is
drawn to files only, and a page embeds the drawing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import isfinite, log10
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

Numbers = tuple[float, ...]
Limits = tuple[float, float]
Runs = tuple[tuple[str, ...], ...]
Direction = Literal["x", "y"]

INK = "#20242a"  #: colour of text and axes; a page replaces it by its text colour
WIDTH = 6.9  #: width of a figure, inches
#: Smallest ratio of the ends of an automatic logarithmic axis: on a shorter axis, 19 to
#: 22 iterations would look like growth.
SPAN = 10.0
#: distance between the points and the ends of an axis, relative to the range of points
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
class Intervals:
    """Ends of the error bars of a series, one for each point."""

    low: Numbers
    high: Numbers
    along: Direction = "y"
    cap: float = 2.0  #: half the length of the strokes at the ends, points
    width: float = 0.7
    opacity: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Series:
    """Points with a line, marks or both; NaN interrupts the line."""

    x: Numbers
    y: Numbers
    look: Look
    intervals: Intervals | None = None
    step: bool = False  #: True for a step function, constant until the next point
    few: bool = False  #: True to draw marks at a few of the points only
    clipped: bool = True  #: True to clip at the edge of the panel
    solver: str = ""  #: solver of the points; empty for none
    runs: Runs = ()  #: run_ids behind each point, or one entry for all points

    def __post_init__(self) -> None:
        ends = (
            () if self.intervals is None else (self.intervals.low, self.intervals.high)
        )
        if any(len(values) != len(self.x) for values in (self.y, *ends)):
            raise ValueError("the coordinates of a series differ in length")
        if len(self.runs) not in (0, 1, len(self.x)):
            raise ValueError(
                f"got {len(self.runs)} lists of runs for {len(self.x)} points"
            )


@dataclass(frozen=True, kw_only=True)
class Area:
    """Area between two curves over the same x."""

    x: Numbers
    low: Numbers
    high: Numbers
    colour: str
    opacity: float
    step: bool = False
    solver: str = ""


@dataclass(frozen=True, kw_only=True)
class Segments:
    """Straight strokes (x0, y0, x1, y1)."""

    ends: tuple[tuple[float, float, float, float], ...]
    colour: str
    width: float = 0.8
    solver: str = ""
    runs: Runs = ()  #: run_ids behind each stroke, or one entry for all


Mark = Series | Area | Segments


@dataclass(frozen=True, kw_only=True)
class Rule:
    """A line across the panel at one value of a coordinate."""

    axis: Direction
    at: float
    look: Look


@dataclass(frozen=True, kw_only=True)
class Text:
    """A text within a panel."""

    text: str  #: text, possibly with mathtext formulas of matplotlib: $n^2$
    place: tuple[float, float]
    inside: tuple[bool, bool] = (
        False,
        False,
    )  #: True if `place` is relative to the panel, for x and y
    offset: tuple[float, float] = (0.0, 0.0)  #: points
    align: tuple[str, str] = ("left", "center")  #: alignment, named as in matplotlib
    size: float = 8.5


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One axis of a panel."""

    label: str = ""
    log: bool = False
    low: float | None = None  #: lower end; None: slightly below the points
    high: float | None = None  #: upper end; None: slightly above the points
    #: positions and labels; None: automatic
    ticks: tuple[tuple[float, str], ...] | None = None
    most: int | None = None  #: approximate number of automatic ticks
    integers: bool = False  #: True for ticks at integers only
    plain: bool = False  #: True for tick labels without powers of ten
    span: float = SPAN  #: smallest ratio of the ends of a logarithmic axis
    numbered: bool = True  #: True if ticks have labels
    marked: bool = True  #: True if ticks have strokes
    line: bool = True
    shared: str = ""  #: axes with the same name have the same ends

    @property
    def bare(self) -> bool:
        """True if the axis has no ticks."""
        return self.ticks == ()


def categories(names: Sequence[str], **how: Any) -> Axis:
    """Return an axis with names from top to bottom; name k = 0, 1, … is at −k."""
    ticks = tuple((-float(k), name) for k, name in enumerate(names))
    defaults = {"low": 0.4 - max(len(names), 1), "high": 0.6, "ticks": ticks}
    return Axis(**{**defaults, "marked": False, **how})


@dataclass(frozen=True, kw_only=True)
class Key:
    """An entry of a legend."""

    label: str
    look: Look
    solver: str = ""  #: solver that the entry shows and hides on a page


@dataclass(frozen=True, kw_only=True)
class Legend:
    """Legend of a panel, of a row or of the whole figure."""

    keys: tuple[Key, ...]
    title: str = ""
    columns: int = 1
    place: Literal["below", "right", "upper left"] = (
        "below"  #: "upper left" is within a panel
    )
    size: float = 9.0


@dataclass(frozen=True, kw_only=True)
class ColourBar:
    """Legend of lines coloured by step: 1, 2, 3 and so on."""

    label: str
    colours: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Panel:
    """Axes with their contents, drawn back to front; rules are behind the marks."""

    x: Axis
    y: Axis
    marks: tuple[Mark, ...] = ()
    rules: tuple[Rule, ...] = ()
    texts: tuple[Text, ...] = ()
    title: str = ""
    legend: Legend | None = None
    bar: ColourBar | None = None
    grid: Literal["both", "x", "y", "none"] = "both"
    span: int = 1  #: number of columns that the panel occupies


@dataclass(frozen=True, kw_only=True)
class Row:
    """Panels side by side."""

    panels: tuple[Panel, ...]
    height: float = 1.0  #: height relative to the other rows
    legend: Legend | None = None


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A figure of curves, with the measurements behind its points."""

    rows: tuple[Row, ...]
    height: float  #: height of the figure, inches
    width: float = WIDTH
    legend: Legend | None = None
    title: str = ""  #: form, tolerance and cases, if no panel names them

    @property
    def panels(self) -> tuple[Panel, ...]:
        """All panels, row by row."""
        return tuple(panel for row in self.rows for panel in row.panels)

    @property
    def columns(self) -> int:
        """Number of columns of the grid of panels."""
        return max(sum(panel.span for panel in row.panels) for row in self.rows)


def numbers(values: ArrayLike) -> Numbers:
    """Convert an array or a sequence to a tuple of floats."""
    return tuple(np.asarray(values, dtype=float).tolist())


def in_rows(panels: Sequence[Panel], columns: int) -> tuple[Row, ...]:
    """Arrange panels in rows of equal height."""
    starts = range(0, len(panels), columns)
    return tuple(Row(panels=tuple(panels[i : i + columns])) for i in starts)


def fitted(figure: Figure) -> Figure:
    """Determine both ends of every axis; automatic ends enclose all marks."""
    rows = tuple(
        replace(row, panels=tuple(_fitted(p, figure.panels) for p in row.panels))
        for row in figure.rows
    )
    return replace(figure, rows=rows)


def _fitted(panel: Panel, panels: Iterable[Panel]) -> Panel:
    ends = {}
    for direction in ("x", "y"):
        axis: Axis = getattr(panel, direction)
        name = axis.shared
        alike = [p for p in panels if name and getattr(p, direction).shared == name]
        low, high = limits(alike or [panel], direction)
        ends[direction] = replace(axis, low=low, high=high)
    return replace(panel, **ends)  # type: ignore[arg-type]


def limits(panels: Sequence[Panel], direction: Literal["x", "y"]) -> Limits:
    """Return the ends of an axis that panels share.

    Ends that are not prescribed lie just beyond the points. A single value is centred;
    without values, a default range is used.
    """
    axis: Axis = getattr(panels[0], direction)
    shown = [v for panel in panels for v in _values(panel, direction) if isfinite(v)]
    if axis.log:
        places = [log10(v) for v in shown if v > 0] or [0.0, 1.0]
    else:
        places = shown or [0.0, 1.0]
    a, b = min(places), max(places)
    lone = 0.5 * abs(a) or 0.5
    pad = MARGIN * (b - a) if b > a or axis.log else lone
    if axis.log:
        pad = max(pad, (log10(axis.span) - (b - a)) / 2)
    low, high = a - pad, b + pad
    if axis.log:
        low, high = 10.0 ** max(low, -300), 10.0 ** min(high, 300)
    low = low if axis.low is None else axis.low
    high = high if axis.high is None else axis.high
    if low < high:
        return low, high
    return (low, 10 * low) if axis.log else (low, low + 1)


def _values(panel: Panel, direction: Direction) -> Iterator[float]:
    """Yield all coordinates of a panel in one direction."""
    across = direction == "x"
    for mark in panel.marks:
        match mark:
            case Series():
                yield from mark.x if across else mark.y
                if mark.intervals is not None and mark.intervals.along == direction:
                    yield from mark.intervals.low
                    yield from mark.intervals.high
            case Area():
                yield from mark.x if across else (*mark.low, *mark.high)
            case Segments():
                for x0, y0, x1, y1 in mark.ends:
                    yield from (x0, x1) if across else (y0, y1)
    yield from (rule.at for rule in panel.rules if rule.axis == direction)
