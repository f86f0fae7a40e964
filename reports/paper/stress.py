"""Figure 7: normal, shear and von Mises stress on the deformed bodies."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from harness import Fields
from reports.figures.deformed import PERCENTILE, SCALE, outlines
from reports.figures.style import INK, STYLE

STRESSES = {
    "sxx": r"normal stress $\sigma_x$",
    "syy": r"normal stress $\sigma_y$",
    "sxy": r"shear stress $\tau_{xy}$",
    "von_mises": r"von Mises stress $\sigma_{\mathrm{vM}}$",
}


class Extent(NamedTuple):
    """Where colours end and what the largest value is, both in size, Pa."""

    clipped: float
    largest: float


def extent(fields: Fields, name: str) -> Extent:
    """Clip where all but a few nodes are within: stresses are singular at corners."""
    size = np.abs(fields.nodal[name])
    return Extent(float(np.percentile(size, PERCENTILE)), float(size.max()))


def stress_figure(fields: Fields) -> Figure:
    """Draw the four components, one colour scale for both bodies in each."""
    with rc_context(STYLE):
        figure = Figure(figsize=(6.9, 4.05))
        panels = figure.subplots(2, 2, sharex=True, sharey=True)
        for letter, axes, (name, title) in zip(
            "abcd", panels.flat, STRESSES.items(), strict=True
        ):
            _panel(figure, axes, fields, name)
            axes.set_title(f"({letter}) {title} in GPa", loc="left")
        for axes in panels[1]:
            axes.set_xlabel("$x$ in m")
        for axes in panels[:, 0]:
            axes.set_ylabel("$y$ in m")
    return figure


def _panel(figure: Figure, axes: Axes, fields: Fields, name: str) -> None:
    limit = extent(fields, name).clipped / 1e9
    signed = name != "von_mises"
    norm = Normalize(-limit if signed else 0, limit)
    colours = colormaps["RdBu_r" if signed else "viridis"]
    moved = fields.points + SCALE * fields.displacement
    for body in np.unique(fields.bodies):
        cells = fields.cells[fields.bodies == body]
        triangles = np.vstack([cells[:, [0, 1, 2]], cells[:, [0, 2, 3]]])
        mesh = Triangulation(moved[:, 0], moved[:, 1], triangles)
        values = fields.nodal[name] / 1e9
        axes.tripcolor(
            mesh, values, cmap=colours, norm=norm, shading="gouraud", rasterized=True
        )
    for loop in outlines(fields.cells):
        axes.plot(*moved[loop].T, color=INK, linewidth=0.6)
    axes.set(aspect="equal")
    bar = figure.colorbar(
        ScalarMappable(norm=norm, cmap=colours), ax=axes,
        orientation="horizontal", extend="both" if signed else "max", aspect=30,
        fraction=0.06, pad=0.02,
    )  # fmt: skip
    bar.outline.set_linewidth(0.5)
