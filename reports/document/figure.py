"""A figure as data: panels of points, intervals, areas and texts, which renderers draw.

A `Figure` is made of curves; files and the interactive page show the same one
(`reports.render.drawing`, `reports.render.plots`). A `FieldFigure` shows bodies to
scale; only files are made of it, and a page embeds their drawing.
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

INK = "#20242a"  #: text and axes; a page replaces it by its own text colour
WIDTH = 6.9  #: of a figure, inches
#: Between the ends of a logarithmic axis that follows its points: on a shorter one, 19
#: to 22 iterations would look like growth.
SPAN = 10.0
MARGIN = 0.05  #: beyond the points, as a part of what they take


@dataclass(frozen=True, kw_only=True)
class Look:
    """How a line and its marks look; widths and sizes in points."""

    colour: str
    marker: str = ""  #: one of "o s ^ D v P X < > x + * _ |", or none
    dash: Numbers | None = ()  #: dashes and gaps in line widths; None: no line at all
    width: float = 1.1
    size: float = 4.5  #: of marks
    edge: float = 1.0  #: width of the outline of marks
    fill: str = ""  #: colour within marks, "none" for hollow ones; empty: `colour`
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
    step: bool = False  #: the value holds until the next point
    few: bool = False  #: mark a few points only
    clipped: bool = True  #: at the edge of the panel
    solver: str = ""  #: whose points these are; empty: nobody's
    runs: Runs = ()  #: run_ids behind each point, or behind all of them (one entry)

    def __post_init__(self) -> None:
        ends = (
            () if self.intervals is None else (self.intervals.low, self.intervals.high)
        )
        if any(len(values) != len(self.x) for values in (self.y, *ends)):
            raise ValueError("the coordinates of a series differ in number")
        if len(self.runs) not in (0, 1, len(self.x)):
            raise ValueError(
                f"{len(self.x)} points have {len(self.runs)} lists of runs"
            )


@dataclass(frozen=True, kw_only=True)
class Area:
    """What lies between two curves over the same x."""

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
    runs: Runs = ()  #: as of a series


Mark = Series | Area | Segments


@dataclass(frozen=True, kw_only=True)
class Rule:
    """A line across the panel where one coordinate has a value."""

    axis: Direction
    at: float
    look: Look


@dataclass(frozen=True, kw_only=True)
class Text:
    """A remark within a panel."""

    text: str  #: formulas as matplotlib reads them: $n^2$
    place: tuple[float, float]
    inside: tuple[bool, bool] = (
        False,
        False,
    )  #: whether `place` is a part of the panel
    offset: tuple[float, float] = (0.0, 0.0)  #: points
    align: tuple[str, str] = ("left", "center")  #: as matplotlib names it
    size: float = 8.5


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One axis of a panel."""

    label: str = ""
    log: bool = False
    low: float | None = None  #: ends; None: a little beyond what is shown
    high: float | None = None
    ticks: tuple[tuple[float, str], ...] | None = None  #: with names; None: numbers
    most: int | None = None  #: numbers along it, about
    integers: bool = False  #: numbers are whole
    plain: bool = False  #: numbers without powers of ten
    span: float = SPAN  #: least factor between the ends of a logarithmic axis
    numbered: bool = True  #: whether ticks have their names
    marked: bool = True  #: whether ticks have their strokes
    line: bool = True
    shared: str = ""  #: axes of the same name have the same ends

    @property
    def bare(self) -> bool:
        """Whether it has no ticks at all."""
        return self.ticks == ()


def categories(names: Sequence[str], **how: Any) -> Axis:
    """Make an axis of names from top to bottom: the k-th is at −k."""
    ticks = tuple((-float(k), name) for k, name in enumerate(names))
    given = {"low": 0.4 - max(len(names), 1), "high": 0.6, "ticks": ticks}
    return Axis(**{**given, "marked": False, **how})


@dataclass(frozen=True, kw_only=True)
class Key:
    """An entry of a legend."""

    label: str
    look: Look
    solver: str = ""  #: that it stands for; a page hides and shows it by its key


@dataclass(frozen=True, kw_only=True)
class Legend:
    """The keys of a panel, of a row or of all of the figure."""

    keys: tuple[Key, ...]
    title: str = ""
    columns: int = 1
    place: Literal["below", "right", "upper left"] = "below"  #: the last within a panel
    size: float = 9.0


@dataclass(frozen=True, kw_only=True)
class ColourBar:
    """What colours of lines mean: the steps 1, 2, 3 and so on."""

    label: str
    colours: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Panel:
    """Axes, and what is drawn in them, back to front; rules lie behind."""

    x: Axis
    y: Axis
    marks: tuple[Mark, ...] = ()
    rules: tuple[Rule, ...] = ()
    texts: tuple[Text, ...] = ()
    title: str = ""
    legend: Legend | None = None
    bar: ColourBar | None = None
    grid: Literal["both", "x", "y", "none"] = "both"
    span: int = 1  #: columns that it takes


@dataclass(frozen=True, kw_only=True)
class Row:
    """Panels side by side."""

    panels: tuple[Panel, ...]
    height: float = 1.0  #: relative to the other rows
    legend: Legend | None = None


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A figure of curves: all that is needed to draw it, and where it comes from."""

    rows: tuple[Row, ...]
    height: float  #: inches
    width: float = WIDTH
    legend: Legend | None = None
    title: str = ""  #: form, tolerance and cases, where no panel names them

    @property
    def panels(self) -> tuple[Panel, ...]:
        """All panels, row by row."""
        return tuple(panel for row in self.rows for panel in row.panels)

    @property
    def columns(self) -> int:
        """Columns of the grid that the panels lie in."""
        return max(sum(panel.span for panel in row.panels) for row in self.rows)


def numbers(values: ArrayLike) -> Numbers:
    """Make plain numbers of an array or a sequence."""
    return tuple(np.asarray(values, dtype=float).tolist())


def in_rows(panels: Sequence[Panel], columns: int) -> tuple[Row, ...]:
    """Put panels into rows of equal height."""
    starts = range(0, len(panels), columns)
    return tuple(Row(panels=tuple(panels[i : i + columns])) for i in starts)


def fitted(figure: Figure) -> Figure:
    """Give both ends to every axis, so that all that is drawn is within."""
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
    """Find the ends of an axis that panels share: as given, or beyond the points.

    Where there is one value only, it is in the middle; without any, there are some.
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
    """All coordinates in one direction."""
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
