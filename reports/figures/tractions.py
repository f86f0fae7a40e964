"""Pressure and shear traction along contact sides, with exact solutions."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mortarbench.harness import ContactSide, Fields, Vector
from mortarbench.reports.figures.deformed import FRICTION, length_unit, prefixed
from mortarbench.reports.figures.style import INK, legend, legible, panels, styled

SHOWN = 1e-6  #: fraction of the largest traction below which a node counts as unloaded
BESIDE = 0.15  #: margin on either side, relative to the length of the loaded part
#: colour and marker of nodes by friction state; frictionless nodes count as open
LOOKS = {"open": ("#6b7480", "o")} | {
    state: (colour, marker)
    for (state, (colour, _)), marker in zip(FRICTION.items(), "so^", strict=True)
}


def loaded_sides(fields: Fields) -> list[ContactSide]:
    """Return the contact sides of plane bodies that are under pressure."""
    sides = fields.contacts if fields.dim == 2 else ()
    return [side for side in sides if side.pressure.max(initial=0.0) > 0]


def traction_figure(fields: Fields) -> Figure:
    """Plot the tractions of each loaded contact of plane bodies in one row.

    Positions are distances from the middle of the undeformed slave side.
    """
    sides = loaded_sides(fields)
    columns = 2 if any(side.shear is not None for side in sides) else 1
    with styled():
        figure, axes = panels(columns * len(sides), columns=columns, height=2.5)
        for row, side in enumerate(sides):
            _draw(axes[columns * row : columns * (row + 1)], fields, side)
        legend(figure, axes)
    return figure


def places(fields: Fields, side: ContactSide) -> Vector:
    """Return nodal positions (s,) along the undeformed side from its middle, m."""
    steps = np.linalg.norm(np.diff(fields.points[side.nodes], axis=0), axis=1)
    along = np.append(0.0, np.cumsum(steps))
    return np.asarray(along - along[-1] / 2)


def _draw(axes: list[Axes], fields: Fields, side: ContactSide) -> None:
    """Draw the pressure and, with friction, the shear traction on the loaded part."""
    along, tractions = places(fields, side), {"pressure": side.pressure}
    if side.shear is not None:
        tractions["shear"] = side.shear
    largest = float(side.pressure.max())
    loaded = np.any([abs(v) > SHOWN * largest for v in tractions.values()], axis=0)
    low, high = along[loaded].min(), along[loaded].max()
    beyond = BESIDE * (high - low) or float(side.length.max())
    low, high = low - beyond, high + beyond
    size, unit = length_unit(high - low)
    states = np.full(side.nodes.size, "open")
    if side.friction is not None:
        states = np.where(side.friction == "", "open", side.friction)
    for column, (kind, values) in enumerate(tractions.items(), 1):
        one = axes[column - 1]
        factor, prefix = prefixed(float(abs(values).max()))
        if side.exact is not None:
            one.plot(
                side.exact[:, 0] / size, side.exact[:, column] / factor,
                color=INK, lw=0.9, label="exact",
            )  # fmt: skip
        for state, (colour, marker) in LOOKS.items():
            of = (states == state) & (low <= along) & (along <= high)
            if of.any():
                one.plot(
                    along[of] / size, values[of] / factor, marker, ms=3.2,
                    color=colour, label="nodes" if side.friction is None else state,
                )  # fmt: skip
        one.set(
            xlim=(low / size, high / size),
            xlabel=f"position along the side in {unit}",
            ylabel=f"{kind} in {prefix}Pa",
            title=legible(side.name) if column == 1 else "",
        )
