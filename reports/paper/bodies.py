"""Figures 1, 2 and 7 and the enlarged contact, drawn to scale."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from mortarbench.harness import Fields
from mortarbench.reports.figures.deformed import (
    PERCENTILE,
    SCALE,
    moved,
    outlines,
    triangles,
)
from mortarbench.reports.figures.fields import Points
from mortarbench.reports.figures.style import COLOURS, INK, panels, styled
from mortarbench.reports.paper.timings import titled

ACTIVE = 1e-6  #: fraction of the largest force above which a node counts as in contact
STRESSES = {
    "sxx": r"normal stress $\sigma_x$",
    "syy": r"normal stress $\sigma_y$",
    "sxy": r"shear stress $\tau_{xy}$",
    "von_mises": r"von Mises stress $\sigma_{\mathrm{vM}}$",
}
#: colours of beam and ring, legible on light and dark pages
FILLS = (to_rgba(COLOURS[0], 0.18), to_rgba(COLOURS[1], 0.22))
_SOFT = "#5c6470"
_ARROW = {"arrowstyle": "->", "color": INK, "lw": 0.7, "shrinkA": 0, "shrinkB": 0}

Place = tuple[float, float]


class Dimensions(NamedTuple):
    """Dimensions of Figure 1, measured on the mesh, m."""

    l: float
    h: float
    a: float
    centre: Place
    r1: float
    r2: float

    def on_circle(self, radius: float, degrees: Any) -> Any:
        """Return the points at angles on a circle around the centre of the ring."""
        angle = np.radians(degrees)
        ends = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return self.centre + radius * ends


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


def geometry_figure(fields: Fields, load: float) -> Figure:
    """Draw Figure 1: bodies, supports, load and dimensions."""
    d = dimensions(fields)
    (x, y), top, right, below = d.centre, d.a + d.h, d.l + 0.11, -0.19
    angles = np.linspace(0, 180, 181)
    ring = np.vstack([d.on_circle(d.r2, angles), d.on_circle(d.r1, angles[::-1])])
    bodies, wide = (_rectangle((0, d.a), d.l, d.h), ring), d.r2 - d.r1 + 0.06
    clamped = [_rectangle((-0.05, d.a - 0.03), 0.05, d.h + 0.06)]
    for foot in (x - d.r2, x + d.r1):
        clamped.append(_rectangle((foot - 0.03, y - 0.05), wide, 0.05))
    with styled():
        figure, (axes,) = panels(1, height=3.45)
        axes.set(xlim=(-0.1, 2.5), ylim=(-0.25, 1.07), aspect="equal")
        axes.axis("off")
        for corners, fill in zip(bodies, FILLS, strict=True):
            axes.fill(*corners.T, fc=fill, ec=INK, lw=0.9)
        for corners in clamped:
            axes.fill(*corners.T, fc="none", ec=_SOFT, hatch="//////", lw=0)
        axes.plot((0.1, d.l + 0.45), (y, y), color=_SOFT, lw=0.5, dashes=(12, 8))
        for line in (
            ((0, 0), (d.a - 0.06, below - 0.03)),
            ((d.l, d.l), (d.a - 0.02, below - 0.03)),
            *(((d.l + 0.02, d.l + 0.14), (at, at)) for at in (d.a, top)),
        ):
            axes.plot(*line, color=_SOFT, lw=0.5)
        outside = x - 0.37, (d.a + y + d.r2) / 2 - 0.07
        both, force = {"arrowstyle": "<->"}, {"color": COLOURS[1], "lw": 1.6}
        for start, end, head in (
            ((0, below), (d.l, below), both),
            ((right, d.a), (right, top), both),
            ((0.14, y), (0.14, d.a), both),
            (d.centre, d.on_circle(d.r1, 128.0), {}),
            (d.centre, d.on_circle(d.r2, 32.0), {}),
            ((d.l, top + 0.28), (d.l, top), {"arrowstyle": "-|>"} | force),
            (outside, (x - 0.03, outside[1] + 0.07), {"arrowstyle": "-", "lw": 0.5}),
        ):
            axes.annotate("", end, start, arrowprops=_ARROW | head)
        axes.plot(*d.centre, "o", color=INK, ms=3)
        edge = d.on_circle(d.r2 + 0.03, 32.0)
        for text, place, across, up in (
            (f"$l={d.l:g}$ m", (d.l / 2, below + 0.015), "center", "bottom"),
            (f"$h={d.h:g}$ m", (right + 0.03, (d.a + top) / 2), "left", "center"),
            (f"$a={d.a:g}$ m", (0.17, y + d.a / 2), "left", "center"),
            (f"$r_1={d.r1:g}$ m", (x + 0.03, y + 0.17), "center", "bottom"),
            (f"$r_2={d.r2:g}$ m", edge, "left", "bottom"),
            (f"$S=[{x:g},\\,{y:g}]$ m", (x, y - 0.02), "center", "top"),
            (f"$F={load / 1e9:g}$ GN/m", (d.l + 0.04, top + 0.27), "left", "top"),
            (f"gap {d.a - d.r2 - y:.2g} m ", outside, "right", "center"),
            ("A", (d.l / 2, d.a + d.h / 2), "center", "center"),
            ("B", d.on_circle((d.r1 + d.r2) / 2, 90), "center", "center"),
        ):
            axes.annotate(text, place, ha=across, va=up)
    return figure


def _rectangle(corner: Place, width: float, height: float) -> Points:
    x, y = corner
    return np.array([(x, y), (x + width, y), (x + width, y + height), (x, y + height)])


def mesh_figure(examples: Mapping[str, Fields]) -> Figure:
    """Draw Figure 2: a row for each mesh, before and after deformation."""
    with styled():
        figure, axes = _common(2 * len(examples), 1.75)
        titles = list[str]()
        for row, (name, fields) in enumerate(examples.items()):
            _mesh(axes[2 * row], fields, fields.points, 0.8)
            _mesh(axes[2 * row + 1], fields, moved(fields), 0.8)
            titles += [name, f"deformed, displacement × {SCALE:g}"]
        titled(axes, *titles)
    return figure


def _common(count: int, height: float) -> tuple[Figure, list[Axes]]:
    """Return panels in two columns with the same axes, to scale."""
    figure, axes = panels(count, height=height, sharex=True, sharey=True)
    for one in axes:
        one.set_aspect("equal")
        one.grid(visible=False)
    for one in axes[-2:]:
        one.set_xlabel("$x$ in m")
    for one in axes[::2]:
        one.set_ylabel("$y$ in m")
    return figure, axes


def _mesh(axes: Axes, fields: Fields, points: Points, width: float) -> None:
    """Draw the cells of every body in its colour, with outlines of `width` points."""
    fills = [FILLS[int(body) % len(FILLS)] for body in fields.bodies]
    cells = PolyCollection(
        list(points[fields.cells]), facecolors=fills, edgecolors=_SOFT, linewidths=0.35
    )
    axes.add_collection(cells)
    _outline(axes, fields, points, width)


def _outline(axes: Axes, fields: Fields, points: Points, width: float) -> None:
    for loop in outlines(fields.cells):
        axes.plot(*points[loop].T, color=INK, lw=width)


def extent(fields: Fields, name: str) -> tuple[float, float]:
    """Return a percentile and the maximum of a stress's absolute nodal values, Pa."""
    size = np.abs(fields.nodal[name])
    return float(np.percentile(size, PERCENTILE)), float(size.max())


def stress_figure(fields: Fields) -> Figure:
    """Draw four stresses, each with one colour scale for both bodies."""
    points = moved(fields)
    bodies = Triangulation(points[:, 0], points[:, 1], triangles(fields.cells))
    with styled():
        figure, axes = _common(len(STRESSES), 2.0)
        for one, name in zip(axes, STRESSES, strict=True):
            limit, signed = extent(fields, name)[0] / 1e9, name != "von_mises"
            colours = one.tripcolor(
                bodies, fields.nodal[name] / 1e9,
                cmap="RdBu_r" if signed else "viridis", shading="gouraud",
                vmin=-limit if signed else 0, vmax=limit, rasterized=True,
            )  # fmt: skip
            _outline(one, fields, points, 0.6)
            bar = figure.colorbar(
                colours, ax=one, location="bottom", aspect=30, fraction=0.06,
                pad=0.02, extend="both" if signed else "max",
            )  # fmt: skip
            bar.outline.set_linewidth(0.5)
        titled(axes, *(f"{title} in GPa" for title in STRESSES.values()))
    return figure


def zoom_figure(fields: Fields) -> Figure:
    """Draw the mesh near the contact, and contact pressures along the normals."""
    points, (side,) = moved(fields), fields.contacts
    size = np.hypot(*side.force.T)
    loaded = size > ACTIVE * size.max()
    normal = -side.force[loaded] / size[loaded, None]
    pressure = size[loaded] / side.length[loaded]
    largest, feet = float(pressure.max()), points[side.nodes][loaded]
    reach = float(np.ptp(feet, axis=0).max())
    scale = 0.3 * reach / largest
    tips = feet + scale * pressure[:, None] * normal
    both = np.vstack([feet, tips])
    low, high = both.min(axis=0) - 0.18 * reach, both.max(axis=0) + 0.1 * reach
    colour, place = COLOURS[1], low + 0.05 * reach
    unit = float(f"{largest / 2:.0e}")  # round value of the scale arrow
    arrow = place + np.array([0, scale * unit])
    with styled():
        figure, (axes,) = panels(1, height=4.1)
        axes.set(aspect="equal", xlabel="$x$ in m", ylabel="$y$ in m")
        axes.grid(visible=False)
        _mesh(axes, fields, points, 0.9)
        band = np.vstack([feet, tips[::-1]])
        axes.fill(*band.T, color=colour, alpha=0.18, lw=0)
        axes.plot(*tips.T, color=colour, lw=1.2)
        axes.quiver(
            *feet.T, *(tips - feet).T, angles="xy", scale_units="xy", scale=1,
            width=0.0022, color=colour,
        )  # fmt: skip
        axes.plot(*feet.T, "o", color=INK, ms=2.4)
        head = {"arrowstyle": "-|>", "color": colour, "lw": 1.2}
        axes.annotate("", arrow, place, arrowprops=_ARROW | head)
        axes.annotate(
            f"pressure {unit / 1e9:g} GPa", (place + arrow) / 2, (6, 0),
            textcoords="offset points", va="center",
        )  # fmt: skip
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.spines[["top", "right"]].set_visible(True)
    return figure
