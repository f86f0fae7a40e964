"""Pressure and shear traction along contact sides, with exact solutions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mortarbench.harness import ContactSide, Fields, Vector
from mortarbench.reports.document.figure import (
    INK,
    Axis,
    Figure,
    Key,
    Look,
    Panel,
    Row,
)
from mortarbench.reports.figures.deformed import FRICTION, length_unit, prefixed
from mortarbench.reports.figures.style import below, curve, legible

SHOWN = 1e-6  #: fraction of the largest pressure below which a node counts as unloaded
BESIDE = 0.15  #: margin on either side, relative to the length of the loaded part
_EXACT = Look(colour=INK, width=0.9)
_NODE = Look(colour="#6b7480", marker="o", dash=None, size=3.2)
#: markers of nodes by friction state; frictionless pairs use the marker of open nodes
LOOKS = {"open": _NODE} | {
    state: replace(_NODE, colour=colour, marker=marker)
    for (state, (colour, _)), marker in zip(FRICTION.items(), "so^", strict=True)
}


def traction_figure(fields: Fields) -> Figure | None:
    """Plot tractions of each loaded contact in one row; None if no contact is loaded.

    Only plane bodies are supported. Positions are distances from the middle of the
    undeformed slave side.
    """
    rows, states, exact = list[Row](), set[str](), False
    for side in fields.contacts if fields.dim == 2 else ():
        if not side.pressure.max(initial=0.0) > 0:
            continue
        rows.append(Row(panels=_panels(fields, side)))
        states |= set(np.unique(_states(side)).tolist())
        exact |= side.exact is not None
    if not rows:
        return None
    rough = any(side.friction is not None for side in fields.contacts)
    keys = [
        Key(label=state if rough else "nodes", look=style)
        for state, style in LOOKS.items()
        if state in states
    ]
    keys += [Key(label="exact", look=_EXACT)] * exact
    return Figure(
        rows=tuple(rows), height=2.5 * len(rows) + 0.5, legend=below(keys, len(keys))
    )


def places(fields: Fields, side: ContactSide) -> Vector:
    """Return nodal positions (s,) along the undeformed side from its middle, m."""
    steps = np.linalg.norm(np.diff(fields.points[side.nodes], axis=0), axis=1)
    along = np.append(0.0, np.cumsum(steps))
    return np.asarray(along - along[-1] / 2)


def _states(side: ContactSide) -> Vector:
    if side.friction is None:
        return np.full(side.nodes.size, "open")
    return np.where(side.friction == "", "open", side.friction)


def _panels(fields: Fields, side: ContactSide) -> tuple[Panel, ...]:
    """Plot the pressure and, with friction, the shear traction on the loaded part."""
    along = places(fields, side)
    tractions = {"pressure": side.pressure}
    if side.shear is not None:
        tractions["shear"] = side.shear
    largest = float(side.pressure.max())
    loaded = np.any([abs(v) > SHOWN * largest for v in tractions.values()], axis=0)
    low, high = along[loaded].min(), along[loaded].max()
    beyond = BESIDE * (high - low) or float(side.length.max())
    low, high = low - beyond, high + beyond
    size, unit = length_unit(high - low)
    axis = Axis(
        label=f"position along the side in {unit}",
        low=float(low / size),
        high=float(high / size),
    )
    panels = []
    for column, (kind, values) in enumerate(tractions.items(), 1):
        factor, prefix = prefixed(float(abs(values).max()))
        curves = {}
        if side.exact is not None:
            curves[_EXACT] = side.exact[:, 0], side.exact[:, column]
        for state, style in LOOKS.items():
            of = _states(side) == state
            curves[style] = along[of], values[of]
        marks = []
        for style, (x, y) in curves.items():
            seen = (low <= x) & (x <= high)
            points = zip(x[seen] / size, y[seen] / factor, strict=True)
            marks += curve(points, style)
        panels.append(
            Panel(
                x=axis,
                y=Axis(label=f"{kind} in {prefix}Pa"),
                marks=tuple(marks),
                title=legible(side.name) if column == 1 else "",
            )
        )
    return tuple(panels)
