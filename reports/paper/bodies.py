"""Figures 1, 2 and 7 and the enlarged contact, drawn to scale."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mortarbench.harness import Fields
from mortarbench.reports.document.fields import (
    Arrow,
    ColourField,
    ColourScale,
    FieldFigure,
    FieldMark,
    FieldPanel,
    Label,
    Path,
    Points,
    Polygons,
    Strokes,
    Vectors,
    box,
)
from mortarbench.reports.document.figure import INK, Look, Numbers
from mortarbench.reports.figures.deformed import (
    PERCENTILE,
    SCALE,
    edges,
    moved,
    outlines,
    triangles,
)
from mortarbench.reports.figures.style import COLOURS

ACTIVE = 1e-6  #: fraction of the largest force above which a node counts as in contact
STRESSES = {
    "sxx": r"normal stress $\sigma_x$",
    "syy": r"normal stress $\sigma_y$",
    "sxy": r"shear stress $\tau_{xy}$",
    "von_mises": r"von Mises stress $\sigma_{\mathrm{vM}}$",
}
#: colour and opacity of beam and ring, legible on light and dark pages
FILLS = ((COLOURS[0], 0.18), (COLOURS[1], 0.22))
_SOFT = "#5c6470"

Place = tuple[float, float]


class Dimensions(NamedTuple):
    """Dimensions of Figure 1, measured on the mesh, m."""

    l: float
    h: float
    a: float
    centre: Place
    r1: float
    r2: float

    def on_circle(self, radius: float, degrees: float) -> Place:
        """Return the point at an angle on a circle around the centre of the ring."""
        angle = np.radians(degrees)
        x, y = self.centre
        return float(x + radius * np.cos(angle)), float(y + radius * np.sin(angle))


def dimensions(fields: Fields) -> Dimensions:
    """Measure the beam (body 0) and the half ring (body 1)."""
    beam, ring = (
        fields.points[np.unique(fields.cells[fields.bodies == b])] for b in (0, 1)
    )
    (x0, y0), (x1, y1) = beam.min(axis=0).tolist(), beam.max(axis=0).tolist()
    left, right = float(ring[:, 0].min()), float(ring[:, 0].max())
    centre = (left + right) / 2, float(ring[:, 1].min())
    inner = float(np.hypot(*(ring - centre).T).min())
    return Dimensions(x1 - x0, y1 - y0, y0, centre, inner, (right - left) / 2)


def geometry_figure(fields: Fields, load: float) -> FieldFigure:
    """Draw Figure 1: bodies, supports, load and dimensions."""
    d = dimensions(fields)
    angles = np.linspace(0, 180, 181)
    ring = [d.on_circle(d.r2, angle) for angle in angles]
    ring += [d.on_circle(d.r1, angle) for angle in angles[::-1]]
    feet = (d.centre[0] - d.r2, d.centre[0] + d.r1)
    clamped = [_rectangle((-0.05, d.a - 0.03), 0.05, d.h + 0.06)]
    clamped += [_rectangle((x - 0.03, -0.05), d.r2 - d.r1 + 0.06, 0.05) for x in feet]
    bodies = zip((_rectangle((0, d.a), d.l, d.h), np.array(ring)), FILLS, strict=True)
    panel = FieldPanel(
        low=(-0.1, -0.25),
        high=(2.5, 1.07),
        axes="none",
        marks=(
            _line((0.1, 0), (d.l + 0.45, 0), dash=(6, 4)),
            *(
                Polygons(corners=(at,), fill=fill, opacity=opacity, edge=INK, width=0.9)
                for at, (fill, opacity) in bodies
            ),
            *(Polygons(corners=(at,), edge=_SOFT, hatch="//////") for at in clamped),
            *_lengths(d),
            *_load(d, load),
            *_names(d),
        ),
    )
    return FieldFigure(panels=(panel,), height=3.45)


def _rectangle(corner: Place, width: float, height: float) -> Points:
    x, y = corner
    return np.array([(x, y), (x + width, y), (x + width, y + height), (x, y + height)])


def _line(start: Place, end: Place, dash: Numbers = ()) -> Path:
    return Path(
        points=np.array([start, end]), look=Look(colour=_SOFT, width=0.5, dash=dash)
    )


def _lengths(d: Dimensions) -> list[FieldMark]:
    top, below, right = d.a + d.h, -0.19, d.l + 0.11
    x, y = d.centre
    edge = d.on_circle(d.r2 + 0.03, 32.0)
    bottom = ("center", "bottom")
    return [
        Arrow(start=(0, below), end=(d.l, below), head="<->"),
        Label(text=f"$l={d.l:g}$ m", place=(d.l / 2, below + 0.015), align=bottom),
        Arrow(start=(right, d.a), end=(right, top), head="<->"),
        Label(text=f"$h={d.h:g}$ m", place=(right + 0.03, (d.a + top) / 2)),
        Arrow(start=(0.14, 0), end=(0.14, d.a), head="<->"),
        Label(text=f"$a={d.a:g}$ m", place=(0.14 + 0.03, d.a / 2)),
        *(
            _line((at, low), (at, below - 0.03))
            for at, low in ((0, d.a - 0.06), (d.l, d.a - 0.02))
        ),
        *(_line((d.l + 0.02, at), (d.l + 0.14, at)) for at in (d.a, top)),
        Arrow(start=d.centre, end=d.on_circle(d.r1, 128.0)),
        Arrow(start=d.centre, end=d.on_circle(d.r2, 32.0)),
        Label(text=f"$r_1={d.r1:g}$ m", place=(x + 0.03, y + 0.17), align=bottom),
        Label(text=f"$r_2={d.r2:g}$ m", place=edge, align=("left", "bottom")),
        Path(
            points=np.array([d.centre]),
            look=Look(colour=INK, marker="o", size=3, dash=None),
        ),
        Label(
            text=f"$S=[{x:g},\\,{y:g}]$ m", place=(x, -0.02), align=("center", "top")
        ),
    ]


def _load(d: Dimensions, load: float) -> list[FieldMark]:
    x, y = d.l, d.a + d.h
    text, colour = f"$F={load / 1e9:g}$ GN/m", COLOURS[1]
    return [
        Arrow(
            start=(x, y + 0.28),
            end=(x, y),
            head="-|>",
            width=1.6,
            colour=colour,
            size=12,
        ),
        Label(
            text=text, place=(x + 0.04, y + 0.27), align=("left", "top"), colour=colour
        ),
    ]


def _names(d: Dimensions) -> list[FieldMark]:
    middle = ("center", "center")
    x, y = d.centre[0], (d.a + d.centre[1] + d.r2) / 2
    outside = (x - 0.38, y - 0.07)
    return [
        Label(text="A", place=(d.l / 2, d.a + d.h / 2), align=middle),
        Label(text="B", place=d.on_circle((d.r1 + d.r2) / 2, 90), align=middle),
        Arrow(
            start=outside, end=(x - 0.03, y), head="-", width=0.5, colour=_SOFT, gap=2
        ),
        Label(
            text=f"gap {d.a - d.r2 - d.centre[1]:.2g} m",
            place=outside,
            align=("right", "center"),
        ),
    ]


def _panels(
    pictures: list[tuple[str, Points, dict[str, Any]]],
) -> tuple[FieldPanel, ...]:
    """Return panels of the same extent in two columns with common axes.

    pictures : title, points of the bodies, further attributes of the panel
    """
    low, high = box(*(points for _, points, _ in pictures))
    panels = []
    for i, (title, _, how) in enumerate(pictures):
        lowest, left = i + 2 >= len(pictures), i % 2 == 0
        panels.append(
            FieldPanel(
                low=low,
                high=high,
                title=f"({'abcdefgh'[i]}) {title}",
                xlabel="$x$ in m" * lowest,
                ylabel="$y$ in m" * left,
                numbered=(lowest, left),
                **how,
            )
        )
    return tuple(panels)


def mesh_figure(examples: dict[str, Fields]) -> FieldFigure:
    """Draw Figure 2: a row for each mesh, before and after deformation."""
    deformed = f"deformed, displacement × {SCALE:g}"
    panels = _panels([
        (name, points, {"marks": mesh(fields, points, 0.8)})
        for title, fields in examples.items()
        for points, name in ((fields.points, title), (moved(fields), deformed))
    ])  # fmt: skip
    rows = len(examples)
    return FieldFigure(
        panels=panels, height=1.62 * rows + 0.25, columns=2, heights=(1,) * rows
    )


def mesh(fields: Fields, points: Points, width: float) -> tuple[FieldMark, ...]:
    """Draw the cells of every body in its colour, with outlines of `width` points."""
    marks: list[FieldMark] = []
    for body in np.unique(fields.bodies):
        cells = fields.cells[fields.bodies == body]
        fill, opacity = FILLS[int(body) % len(FILLS)]
        marks += [
            Polygons(corners=tuple(points[cells]), fill=fill, opacity=opacity),
            Strokes(ends=points[edges(cells)], colour=_SOFT, width=0.35),
        ]
    return (*marks, *_outlined(fields, points, width))


def _outlined(fields: Fields, points: Points, width: float) -> list[Path]:
    look = Look(colour=INK, width=width)
    return [Path(points=points[loop], look=look) for loop in outlines(fields.cells)]


class Extent(NamedTuple):
    """End of the colour scale and largest absolute value, Pa."""

    clipped: float
    largest: float


def extent(fields: Fields, name: str) -> Extent:
    """Return a percentile and the maximum of a stress's absolute nodal values."""
    size = np.abs(fields.nodal[name])
    return Extent(float(np.percentile(size, PERCENTILE)), float(size.max()))


def stress_figure(fields: Fields) -> FieldFigure:
    """Draw four stresses, each with one colour scale for both bodies."""
    points = moved(fields)
    pictures = []
    for name, title in STRESSES.items():
        limit, signed = extent(fields, name).clipped, name != "von_mises"
        scale = ColourScale(
            colours="RdBu_r" if signed else "viridis",
            low=-limit if signed else 0,
            high=limit,
            unit=1e9,
            beyond="both" if signed else "max",
        )
        colours = [
            ColourField(
                points=points,
                triangles=triangles(fields.cells[fields.bodies == body]),
                values=fields.nodal[name],
                scale=scale,
            )
            for body in np.unique(fields.bodies)
        ]
        marks = (*colours, *_outlined(fields, points, 0.6))
        pictures.append((f"{title} in GPa", points, {"marks": marks, "scale": scale}))
    return FieldFigure(panels=_panels(pictures), height=4.05, columns=2, heights=(1, 1))


def zoom_figure(fields: Fields) -> FieldFigure:
    """Draw the mesh near the contact, and contact pressures along the normals."""
    assert fields.contact_nodes is not None
    assert fields.contact_forces is not None
    points = moved(fields)
    size = np.hypot(*fields.contact_forces.T)
    loaded = size > ACTIVE * size.max()
    # undeformed arc length of each slave node, m
    sides = np.diff(fields.points[fields.contact_nodes], axis=0)
    half = np.linalg.norm(sides, axis=1) / 2
    lengths = np.append(half, 0) + np.append(0, half)
    normal = -fields.contact_forces[loaded] / size[loaded, None]
    pressure = size[loaded] / lengths[loaded]
    largest = float(pressure.max())
    feet = points[fields.contact_nodes][loaded]
    reach = float(np.ptp(feet, axis=0).max())
    scale = 0.3 * reach / largest
    tips = feet + scale * pressure[:, None] * normal
    both = np.vstack([feet, tips])
    x0, y0 = (both.min(axis=0) - 0.18 * reach).tolist()
    x1, y1 = (both.max(axis=0) + 0.1 * reach).tolist()
    # round value of the scale arrow
    unit, colour = float(f"{largest / 2:.0e}"), COLOURS[1]
    x, y, arrow = x0 + 0.05 * reach, y0 + 0.05 * reach, scale * unit
    panel = FieldPanel(
        low=(x0, y0),
        high=(x1, y1),
        marks=(
            *mesh(fields, points, 0.9),
            Polygons(
                corners=(np.vstack([feet, tips[::-1]]),), fill=colour, opacity=0.18
            ),
            Path(points=tips, look=Look(colour=colour, width=1.2)),
            Vectors(feet=feet, vectors=tips - feet, colour=colour, width=0.0022),
            Path(points=feet, look=Look(colour=INK, marker="o", size=2.4, dash=None)),
            Arrow(
                start=(x, y), end=(x, y + arrow), head="-|>", width=1.2, colour=colour
            ),
            Label(
                text=f"pressure {unit / 1e9:g} GPa",
                place=(x, y + arrow / 2),
                offset=(6, 0),
            ),
        ),
        xlabel="$x$ in m",
        ylabel="$y$ in m",
        axes="frame",
    )
    return FieldFigure(panels=(panel,), height=4.1)
