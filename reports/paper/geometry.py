"""Figures 1 and 2: the bodies with their dimensions, the mesh and the deformed mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mortarbench.harness import Fields
from mortarbench.reports.document.fields import (
    Arrow,
    FieldFigure,
    FieldMark,
    FieldPanel,
    Label,
    Path,
    Points,
    Polygons,
    Strokes,
    box,
)
from mortarbench.reports.document.figure import INK, Look, Numbers
from mortarbench.reports.figures.deformed import SCALE, edges, moved, outlines
from mortarbench.reports.figures.style import COLOURS

#: of beam and ring: transparent, so that ink stays readable on any page
FILLS = ((COLOURS[0], 0.18), (COLOURS[1], 0.22))
_SOFT = "#5c6470"

Place = tuple[float, float]


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


def geometry_figure(fields: Fields, load: float) -> FieldFigure:
    """Show Figure 1: bodies, supports, load and dimensions."""
    d = dimensions(fields)
    axis = _line((0.1, 0), (d.l + 0.45, 0), dash=(6, 4))
    feet = (d.centre[0] - d.r2, d.centre[0] + d.r1)
    supports = [_support((-0.05, d.a - 0.03), 0.05, d.h + 0.06)]
    supports += [_support((x - 0.03, -0.05), d.r2 - d.r1 + 0.06, 0.05) for x in feet]
    panel = FieldPanel(
        low=(-0.1, -0.25), high=(2.5, 1.07), axes="none",
        marks=(
            axis, _body(_rectangle((0, d.a), d.l, d.h), 0), _body(_half_ring(d), 1),
            *supports, *_lengths(d), *_load(d, load), *_names(d),
        ),
    )  # fmt: skip
    return FieldFigure(panels=(panel,), height=3.45)


def _body(corners: Points, body: int) -> Polygons:
    fill, opacity = FILLS[body]
    return Polygons(corners=(corners,), fill=fill, opacity=opacity, edge=INK, width=0.9)


def _rectangle(corner: tuple[float, float], width: float, height: float) -> Points:
    x, y = corner
    return np.array([(x, y), (x + width, y), (x + width, y + height), (x, y + height)])


def _half_ring(d: Dimensions) -> Points:
    angles = np.linspace(0, 180, 181)
    outer = [_on_circle(d, d.r2, angle) for angle in angles]
    inner = [_on_circle(d, d.r1, angle) for angle in angles[::-1]]
    return np.array(outer + inner)


def _support(corner: tuple[float, float], width: float, height: float) -> Polygons:
    area = _rectangle(corner, width, height)
    return Polygons(corners=(area,), edge=_SOFT, hatch="//////")


def _line(start: Place, end: Place, dash: Numbers = ()) -> Path:
    return Path(
        points=np.array([start, end]), look=Look(colour=_SOFT, width=0.5, dash=dash)
    )


def _lengths(d: Dimensions) -> list[FieldMark]:
    top, below, right = d.a + d.h, -0.19, d.l + 0.11
    x, y = d.centre
    edge = _on_circle(d, d.r2 + 0.03, 32.0)
    return [
        *_dimension((0, below), (d.l, below), f"$l={d.l:g}$ m", "above"),
        *_dimension((right, d.a), (right, top), f"$h={d.h:g}$ m", "right"),
        *_dimension((0.14, 0), (0.14, d.a), f"$a={d.a:g}$ m", "right"),
        *(
            _line((at, low), (at, below - 0.03))
            for at, low in ((0, d.a - 0.06), (d.l, d.a - 0.02))
        ),
        *(_line((d.l + 0.02, at), (d.l + 0.14, at)) for at in (d.a, top)),
        Arrow(start=d.centre, end=_on_circle(d, d.r1, 128.0)),
        Arrow(start=d.centre, end=_on_circle(d, d.r2, 32.0)),
        Label(
            text=f"$r_1={d.r1:g}$ m", place=(x + 0.03, y + 0.17),
            align=("center", "bottom"),
        ),
        Label(text=f"$r_2={d.r2:g}$ m", place=edge, align=("left", "bottom")),
        Path(
            points=np.array([d.centre]),
            look=Look(colour=INK, marker="o", size=3, dash=None),
        ),
        Label(
            text=f"$S=[{x:g},\\,{y:g}]$ m", place=(x, -0.02), align=("center", "top")
        ),
    ]  # fmt: skip


def _on_circle(d: Dimensions, radius: float, degrees: float) -> Place:
    """Find the point at an angle on a circle around the ring's centre."""
    angle = np.radians(degrees)
    x, y = d.centre
    return float(x + radius * np.cos(angle)), float(y + radius * np.sin(angle))


def _dimension(start: Place, end: Place, text: str, side: str) -> list[FieldMark]:
    """Make an arrow with two heads, and its text above it or to its right."""
    x, y = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
    label = (
        Label(text=text, place=(x, y + 0.015), align=("center", "bottom"))
        if side == "above"
        else Label(text=text, place=(x + 0.03, y))
    )
    return [Arrow(start=start, end=end, head="<->"), label]


def _load(d: Dimensions, load: float) -> list[FieldMark]:
    x, y = d.l, d.a + d.h
    text, colour = f"$F={load / 1e9:g}$ GN/m", COLOURS[1]
    return [
        Arrow(
            start=(x, y + 0.28), end=(x, y), head="-|>", width=1.6, colour=colour,
            size=12,
        ),
        Label(
            text=text, place=(x + 0.04, y + 0.27), align=("left", "top"), colour=colour
        ),
    ]  # fmt: skip


def _names(d: Dimensions) -> list[FieldMark]:
    middle = ("center", "center")
    x, y = d.centre[0], (d.a + d.centre[1] + d.r2) / 2
    outside = (x - 0.38, y - 0.07)
    return [
        Label(text="A", place=(d.l / 2, d.a + d.h / 2), align=middle),
        Label(text="B", place=_on_circle(d, (d.r1 + d.r2) / 2, 90), align=middle),
        Arrow(
            start=outside, end=(x - 0.03, y), head="-", width=0.5, colour=_SOFT, gap=2
        ),
        Label(
            text=f"gap {d.a - d.r2 - d.centre[1]:.2g} m", place=outside,
            align=("right", "center"),
        ),
    ]  # fmt: skip


def mesh_figure(examples: dict[str, Fields]) -> FieldFigure:
    """Show Figure 2: a row for each mesh, by title, before and after deformation."""
    low, high = box(*(p for f in examples.values() for p in (f.points, moved(f))))
    panels: list[FieldPanel] = []
    for title, fields in examples.items():
        lowest = len(panels) + 2 == 2 * len(examples)
        for points, what in (
            (fields.points, title),
            (moved(fields), f"deformed, displacement × {SCALE:g}"),
        ):
            left = len(panels) % 2 == 0
            panels.append(
                FieldPanel(
                    low=low, high=high, marks=mesh(fields, points, 0.8),
                    title=f"({'abcdefgh'[len(panels)]}) {what}",
                    xlabel="$x$ in m" * lowest, ylabel="$y$ in m" * left,
                    numbered=(lowest, left),
                )
            )  # fmt: skip
    rows = len(examples)
    return FieldFigure(
        panels=tuple(panels), height=1.62 * rows + 0.25, columns=2, heights=(1,) * rows
    )


def mesh(fields: Fields, points: Points, width: float) -> tuple[FieldMark, ...]:
    """Show the cells of every body in its colour; `width` is that of the outlines."""
    marks: list[FieldMark] = []
    for body in np.unique(fields.bodies):
        cells = fields.cells[fields.bodies == body]
        fill, opacity = FILLS[int(body) % len(FILLS)]
        marks += [
            Polygons(corners=tuple(points[cells]), fill=fill, opacity=opacity),
            Strokes(ends=points[edges(cells)], colour=_SOFT, width=0.35),
        ]
    look = Look(colour=INK, width=width)
    loops = outlines(fields.cells)
    return (*marks, *(Path(points=points[loop], look=look) for loop in loops))
