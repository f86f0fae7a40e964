"""Maps of the tractions between half-spaces: pressure, shear, stick and slip."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import ContactSide, Fields, Vector
from mortarbench.reports.figures.deformed import length_unit, prefixed
from mortarbench.reports.figures.fields import (
    ColourScale,
    FieldFigure,
    FieldMark,
    FieldPanel,
    Look,
    Path,
    Raster,
    Vectors,
)
from mortarbench.reports.figures.style import INK, WIDTH

_KINDS = ColourScale(
    colours=("#a9cbe6", "#efb0aa"),
    low=0,
    high=2,
    names=("stick", "slip"),
    label="state",
)
_EXACT = Look(colour=INK, width=0.8, dash=(4, 2.5))
_ARROWS = 13  #: number of arrows across the contact
_CLOSED = 1e-6  #: fraction of the largest pressure below which a cell counts as open
_MARGIN = 0.06  #: margin around the contact, relative to its size
_CIRCLE = np.linspace(0, 2 * np.pi, 181)


def traction_maps(fields: Fields) -> FieldFigure | None:
    """Draw the tractions on the surface of half-spaces; None if there are no tractions.

    With friction, arrows show the direction in which the upper body slips, opposite to
    the shear traction on it. Circles are the exact edges of contact and stick zone, if
    known.
    """
    if fields.dim != 3 or len(fields.cells) or len(fields.contacts) != 1:
        return None
    (side,) = fields.contacts
    closed = side.pressure > _CLOSED * side.pressure.max(initial=0.0)
    if not closed.any():
        return None
    grid = _Grid(fields.points[side.nodes, :2], float(np.sqrt(side.length[0])), closed)
    circles = _circles(side)
    values = {"pressure": side.pressure}
    if side.shear is not None:
        values["shear traction"] = side.shear
    alone = side.friction is None
    panels = [
        grid.panel(
            name if alone else f"({letter}) {name}", v, _scale(name, v), circles * alone
        )
        for letter, (name, v) in zip("ab", values.items(), strict=False)
    ]
    if not alone:
        slips = closed & (side.friction == "slip")
        arrows = grid.arrows(-side.force[:, :2], slips)
        kinds = np.where(side.friction == "slip", 1.5, 0.5)
        panels.append(
            grid.panel("(c) direction of slip", kinds, _KINDS, (*circles, *arrows))
        )
    columns = len(panels)
    return FieldFigure(
        panels=tuple(panels),
        columns=columns,
        height=3.1 if columns > 1 else 4.2,
        width=WIDTH if columns > 1 else 3.6,
    )


class _Grid:
    """Regular grid of cells, some of which are in contact."""

    def __init__(
        self, centres: NDArray[np.float64], h: float, closed: NDArray[np.bool_]
    ) -> None:
        self.centres, self.h, self.closed = centres, h, closed
        self.corner = centres.min(axis=0)
        self.places = np.rint((centres - self.corner) / h).astype(np.int64)
        low, high = centres[closed].min(axis=0), centres[closed].max(axis=0)
        self.size = float((high - low).max()) + h
        margin = self.h / 2 + _MARGIN * self.size
        self.low, self.high = low - margin, high + margin

    def panel(
        self,
        title: str,
        values: Vector,
        scale: ColourScale,
        above: tuple[FieldMark, ...],
    ) -> FieldPanel:
        """Colour the closed cells by values (k,)."""
        shown = np.full(self.places.max(axis=0) + 1, np.nan)
        shown[tuple(self.places[self.closed].T)] = values[self.closed]
        low = self.corner - self.h / 2
        high = low + self.h * np.array(shown.shape)
        raster = Raster(low=_pair(low), high=_pair(high), values=shown, scale=scale)
        unit, name = length_unit(self.size)
        first = not title.startswith(("(b)", "(c)"))
        return FieldPanel(
            low=_pair(self.low),
            high=_pair(self.high),
            marks=(raster, *above),
            title=title,
            xlabel=f"$x$ in {name}",
            unit=unit,
            ylabel=f"$y$ in {name}" if first else "",
            numbered=(True, first),
            scale=scale,
        )

    def arrows(
        self, vectors: NDArray[np.float64], at: NDArray[np.bool_]
    ) -> tuple[FieldMark, ...]:
        """Draw the directions of vectors (k, 2) at cells `at` on a coarser grid."""
        extent = self.places.max(axis=0)
        step = max(1, round(self.size / self.h / _ARROWS))
        step += (step + int(extent[0])) % 2  # centres the coarser grid on the cells
        lattice = (2 * self.places - extent) % (2 * step) == step
        drawn = at & lattice.all(axis=1)
        if not drawn.any():
            return ()
        along = vectors[drawn]
        along = along / np.linalg.norm(along, axis=1)[:, None] * 0.7 * step * self.h
        feet = self.centres[drawn] - along / 2
        return (Vectors(feet=feet, vectors=along, colour=INK, width=0.006),)


def _scale(name: str, values: Vector) -> ColourScale:
    largest = float(values.max())
    factor, prefix = prefixed(largest)
    return ColourScale(
        colours="viridis",
        low=0,
        high=largest or 1.0,
        unit=factor,
        label=f"{name} in {prefix}Pa",
    )


def _circles(side: ContactSide) -> tuple[FieldMark, ...]:
    """Return the exact edges of the contact and of the stick zone, if known."""
    if side.exact is None:
        return ()
    r, pressure, shear = side.exact.T
    closed = pressure > 0
    radii = [r[closed].max()]
    ratio = shear[closed] / pressure[closed]
    if shear.any():
        radii.append(r[closed][ratio < ratio.max() * (1 - _CLOSED)].max())
    unit = np.column_stack([np.cos(_CIRCLE), np.sin(_CIRCLE)])
    return tuple(Path(points=radius * unit, look=_EXACT) for radius in radii)


def _pair(point: NDArray[np.float64]) -> tuple[float, float]:
    return float(point[0]), float(point[1])
