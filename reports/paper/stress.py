"""Figure 7: normal, shear and von Mises stress on the deformed bodies."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mortarbench.harness import Fields
from mortarbench.reports.document.fields import (
    ColourField,
    ColourScale,
    FieldFigure,
    FieldMark,
    FieldPanel,
    Path,
    box,
)
from mortarbench.reports.document.figure import INK, Look
from mortarbench.reports.figures.deformed import PERCENTILE, moved, outlines, triangles

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


def stress_figure(fields: Fields) -> FieldFigure:
    """Show the four components, one colour scale for both bodies in each."""
    low, high = box(moved(fields))
    panels = []
    for i, (name, title) in enumerate(STRESSES.items()):
        lower, left = i // 2 == 1, i % 2 == 0
        panels.append(
            FieldPanel(
                low=low, high=high, marks=_marks(fields, name),
                scale=_scale(fields, name),
                title=f"({'abcd'[i]}) {title} in GPa", numbered=(lower, left),
                xlabel="$x$ in m" * lower, ylabel="$y$ in m" * left,
            )
        )  # fmt: skip
    return FieldFigure(panels=tuple(panels), height=4.05, columns=2, heights=(1, 1))


def _scale(fields: Fields, name: str) -> ColourScale:
    limit = extent(fields, name).clipped
    signed = name != "von_mises"
    return ColourScale(
        colours="RdBu_r" if signed else "viridis", low=-limit if signed else 0,
        high=limit, unit=1e9, beyond="both" if signed else "max",
    )  # fmt: skip


def _marks(fields: Fields, name: str) -> tuple[FieldMark, ...]:
    points, scale = moved(fields), _scale(fields, name)
    colours = [
        ColourField(
            points=points, triangles=triangles(fields.cells[fields.bodies == body]),
            values=fields.nodal[name], scale=scale,
        )
        for body in np.unique(fields.bodies)
    ]  # fmt: skip
    style = Look(colour=INK, width=0.6)
    loops = outlines(fields.cells)
    return (*colours, *(Path(points=points[loop], look=style) for loop in loops))
