"""Figures 1 and 2: the bodies with their dimensions, the mesh and the deformed mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle, Wedge
from numpy.typing import NDArray

from harness import Fields
from reports.figures.deformed import SCALE, edges, outlines
from reports.figures.style import COLOURS, INK, STYLE

#: of beam and ring: transparent, so that ink stays readable on any page
FILLS = (to_rgba(COLOURS[0], 0.18), to_rgba(COLOURS[1], 0.22))
_SOFT = "#5c6470"


@dataclass(frozen=True)
class Dimensions:
    """Those of Figure 1, m, read off the mesh."""

    l: float
    h: float
    a: float
    centre: tuple[float, float]
    r1: float
    r2: float


def dimensions(fields: Fields) -> Dimensions:
    """Measure the beam (body 0) and the half ring (body 1)."""
    beam, ring = (
        fields.points[np.unique(fields.cells[fields.bodies == b])] for b in (0, 1)
    )
    (x0, y0), (x1, y1) = beam.min(axis=0), beam.max(axis=0)
    left, right = ring[:, 0].min(), ring[:, 0].max()
    centre = ((left + right) / 2, ring[:, 1].min())
    inner = np.hypot(*(ring - centre).T).min()
    numbers = (x1 - x0, y1 - y0, y0, centre, inner, (right - left) / 2)
    l, h, a, S, r1, r2 = numbers
    return Dimensions(
        float(l), float(h), float(a), (float(S[0]), float(S[1])), float(r1), float(r2)
    )


def geometry_figure(fields: Fields, load: float) -> Figure:
    """Draw Figure 1: bodies, supports, load and dimensions."""
    d = dimensions(fields)
    with rc_context(STYLE):
        figure = Figure(figsize=(6.9, 3.45))
        axes = figure.subplots()
        axes.set(aspect="equal", xlim=(-0.1, 2.5), ylim=(-0.25, 1.07))
        axes.axis("off")
        style: Any = {"edgecolor": INK, "linewidth": 0.9}
        axes.add_patch(Rectangle((0, d.a), d.l, d.h, facecolor=FILLS[0], **style))
        axes.add_patch(
            Wedge(d.centre, d.r2, 0, 180, width=d.r2 - d.r1, facecolor=FILLS[1],
                  **style)
        )  # fmt: skip
        _support(axes, (-0.05, d.a - 0.03), 0.05, d.h + 0.06)
        for foot in (d.centre[0] - d.r2, d.centre[0] + d.r1):
            _support(axes, (foot - 0.03, -0.05), d.r2 - d.r1 + 0.06, 0.05)
        axes.plot(
            (0.1, d.l + 0.45), (0, 0), color=_SOFT, lw=0.5, ls=(0, (6, 4)), zorder=0
        )
        _lengths(axes, d)
        _load(axes, d, load)
        _names(axes, d)
    return figure


def _support(axes: Axes, corner: tuple[float, float], w: float, h: float) -> None:
    axes.add_patch(
        Rectangle(corner, w, h, facecolor="none", edgecolor=_SOFT, hatch="//////", lw=0)
    )


def _lengths(axes: Axes, d: Dimensions) -> None:
    top, below = d.a + d.h, -0.19
    _dimension(axes, (0, below), (d.l, below), f"$l={d.l:g}$ m", "above")
    _dimension(axes, (d.l + 0.11, d.a), (d.l + 0.11, top), f"$h={d.h:g}$ m", "right")
    _dimension(axes, (0.14, 0), (0.14, d.a), f"$a={d.a:g}$ m", "right")
    thin: Any = {"color": _SOFT, "linewidth": 0.5}
    for x, low in ((0, d.a - 0.06), (d.l, d.a - 0.02)):
        axes.plot((x, x), (low, below - 0.03), **thin)
    for y in (d.a, top):
        axes.plot((d.l + 0.02, d.l + 0.14), (y, y), **thin)
    for radius, angle in ((d.r1, 128.0), (d.r2, 32.0)):
        axes.annotate("", _on_circle(d, radius, angle), d.centre, arrowprops=_ARROW)
    x, y = d.centre
    axes.text(x + 0.03, y + 0.17, f"$r_1={d.r1:g}$ m", ha="center", va="bottom")
    x, y = _on_circle(d, d.r2 + 0.03, 32.0)
    axes.text(x, y, f"$r_2={d.r2:g}$ m", ha="left", va="bottom")
    axes.plot(*d.centre, "o", color=INK, markersize=3)
    axes.text(
        d.centre[0], -0.02, f"$S=[{d.centre[0]:g},\\,{d.centre[1]:g}]$ m",
        ha="center", va="top",
    )  # fmt: skip


def _on_circle(d: Dimensions, radius: float, degrees: float) -> tuple[float, float]:
    """Find the point at an angle on a circle around the ring's centre."""
    angle = np.radians(degrees)
    x, y = d.centre
    return float(x + radius * np.cos(angle)), float(y + radius * np.sin(angle))


_ARROW = {"arrowstyle": "->", "lw": 0.7, "color": INK, "shrinkA": 0, "shrinkB": 0}


def _dimension(
    axes: Axes,
    start: tuple[float, float],
    end: tuple[float, float],
    text: str,
    side: str,
) -> None:
    axes.annotate("", end, start, arrowprops={**_ARROW, "arrowstyle": "<->"})
    x, y = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
    if side == "above":
        axes.text(x, y + 0.015, text, ha="center", va="bottom")
    else:
        axes.text(x + 0.03, y, text, ha="left", va="center")


def _load(axes: Axes, d: Dimensions, load: float) -> None:
    tip = (d.l, d.a + d.h)
    arrow = {"arrowstyle": "-|>", "lw": 1.6, "color": COLOURS[1], "shrinkA": 0,
             "shrinkB": 0, "mutation_scale": 12}  # fmt: skip
    axes.annotate("", tip, (tip[0], tip[1] + 0.28), arrowprops=arrow)
    text = f"$F={load / 1e9:g}$ GN/m"
    axes.text(tip[0] + 0.04, tip[1] + 0.27, text, color=COLOURS[1], va="top")


def _names(axes: Axes, d: Dimensions) -> None:
    axes.text(d.l / 2, d.a + d.h / 2, "A", ha="center", va="center")
    middle = _on_circle(d, (d.r1 + d.r2) / 2, 90)
    axes.text(*middle, "B", ha="center", va="center")
    x, y = d.centre[0], (d.a + d.centre[1] + d.r2) / 2
    axes.annotate(
        f"gap {d.a - d.r2 - d.centre[1]:.2g} m", (x - 0.03, y), (x - 0.38, y - 0.07),
        ha="right", va="center",
        arrowprops={"arrowstyle": "-", "lw": 0.5, "color": _SOFT, "shrinkB": 0},
    )  # fmt: skip


def mesh_figure(examples: dict[str, Fields]) -> Figure:
    """Draw Figure 2: a row for each mesh, by title, before and after deformation."""
    with rc_context(STYLE):
        figure = Figure(figsize=(6.9, 1.62 * len(examples) + 0.25))
        grid = figure.subplots(
            len(examples), 2, sharex=True, sharey=True, squeeze=False
        )
        letters = iter("abcdefgh")
        for row, (title, fields) in zip(grid, examples.items(), strict=True):
            moved = fields.points + SCALE * fields.displacement
            for axes, points, what in (
                (row[0], fields.points, title),
                (row[1], moved, f"deformed, displacement × {SCALE:g}"),
            ):
                _mesh(axes, fields, points)
                axes.set(aspect="equal")
                axes.set_title(f"({next(letters)}) {what}", loc="left")
            row[0].set_ylabel("$y$ in m")
        for axes in grid[-1]:
            axes.set_xlabel("$x$ in m")
    return figure


def _mesh(axes: Axes, fields: Fields, points: NDArray[np.float64]) -> None:
    for body in np.unique(fields.bodies):
        cells = fields.cells[fields.bodies == body]
        fill = FILLS[int(body) % len(FILLS)]
        axes.add_collection(
            PolyCollection(list(points[cells]), facecolor=fill, edgecolor="none")
        )
        axes.add_collection(
            LineCollection(list(points[edges(cells)]), color=_SOFT, linewidth=0.35)
        )
    for loop in outlines(fields.cells):
        axes.plot(*points[loop].T, color=INK, linewidth=0.8)
