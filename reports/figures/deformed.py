"""Deformed bodies: meshes, their outlines, their stress, the forces between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from harness import Fields, InputError, Vector
from reports.document.fields import (
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
)
from reports.document.figure import INK, Look

PERCENTILE = 99.5  #: where colours are clipped: stresses are singular at corners
SCALE = 1.0  #: of the displacement: the bodies are where the computation puts them
_MESH_SHOWN = 6000  #: cells; the lines of a finer mesh would hide the colours
_ACTIVE = 1e-6  #: a contact node is loaded if its force exceeds this times the largest
_ARROW = "#101214"  #: dark on every page: arrows stand on the bodies' colours
_WIDTH = 5.62  #: of the panels, inches, beside the colour bar and its label
_TALLEST = 7.5  #: inches, of the panel of tall bodies
_FLAT = 0.34  #: height over width of the enlargement
_PLAIN = ColourScale(colours="Greys", low=0, high=1)
_OUTLINE = Look(colour=INK, width=0.7)
_BEFORE = Look(colour="#8a93a0", width=0.7, dash=(4, 2.5))


def clipped_at(fields: Fields) -> tuple[float, float] | None:
    """Say where the colours end and the largest stress, Pa; None without stress."""
    stress = fields.nodal.get("von_mises")
    if stress is None:
        return None
    return float(np.percentile(stress, PERCENTILE)), float(np.max(stress))


def deformed_figure(fields: Fields) -> FieldFigure:
    """Show all bodies, and their contact enlarged where contact forces are given.

    Raises
    ------
    InputError
        When displacement or stress is not finite, or the bodies have no extent.

    """
    shown = (fields.displacement, fields.nodal.get("von_mises", 0.0))
    if not all(np.isfinite(values).all() for values in shown):
        raise InputError("displacement or stress holds NaN or inf: there is no picture")
    if not np.ptp(fields.points, axis=0).all():
        raise InputError("bodies of no width or no height: there is no picture")
    forces = fields.contact_forces
    loaded = forces is not None and bool(np.any(forces))
    low, high = _box(fields)
    width, height = high - low
    pad = 0.02 * width
    drawn = min(_WIDTH * (height + 2 * pad) / (width + 2 * pad), _TALLEST)
    enlarged = _WIDTH * _FLAT if loaded else 0.0
    scale = _scale(fields)
    bodies = _bodies(fields, scale)
    before, after = (
        [Path(points=points[loop], look=style) for loop in outlines(fields.cells)]
        for points, style in ((fields.points, _BEFORE), (moved(fields), _OUTLINE))
    )
    corners = low - pad, high + pad
    overview = FieldPanel(
        low=_pair(corners[0]), high=_pair(corners[1]),
        marks=(*bodies, *before, *after, *(_frame(fields, *corners) if loaded else ())),
        title=f"{'(a) ' if loaded else ''}deformed bodies, displacement × {SCALE:g}; "
        "dashed: undeformed",
        xlabel="$x$ in m", ylabel="$y$ in m",
    )  # fmt: skip
    return FieldFigure(
        panels=(overview, _enlarged(fields, (*bodies, *after)))
        if loaded
        else (overview,),
        height=drawn + enlarged + (1.24 if loaded else 0.55),
        heights=(drawn, enlarged) if loaded else (drawn,),
        scale=scale,
    )


def moved(fields: Fields) -> Points:
    """(n, 2) where the displacement puts the nodes."""
    return cast(Points, fields.points + SCALE * fields.displacement)


def _pair(point: Vector) -> tuple[float, float]:
    return float(point[0]), float(point[1])


def _box(fields: Fields) -> tuple[Vector, Vector]:
    """Lower left and upper right corner of the bodies, before and after."""
    both = np.vstack([fields.points, moved(fields)])
    return both.min(axis=0), both.max(axis=0)


def _scale(fields: Fields) -> ColourScale | None:
    """One scale in Pa, shared by all bodies."""
    limits = clipped_at(fields)
    if limits is None:
        return None
    clipped, largest = limits
    factor, prefix = _prefixed(clipped)
    return ColourScale(
        colours="viridis", low=0, high=clipped or 1.0, unit=factor,
        label=f"von Mises stress in {prefix}Pa",
        beyond="max" if largest > clipped else "neither",
    )  # fmt: skip


def _prefixed(value: float) -> tuple[float, str]:
    """Choose the unit prefix in which `value` is between 1 and 1000."""
    known = ((1e9, "G"), (1e6, "M"), (1e3, "k"))
    return next((p for p in known if value >= p[0]), (1.0, ""))


def _bodies(fields: Fields, scale: ColourScale | None) -> list[FieldMark]:
    """Show every body: stress and mesh, deformed."""
    points = moved(fields)
    stress = np.full(len(points), 0.3) if scale is None else fields.nodal["von_mises"]
    marks: list[FieldMark] = []
    for body in np.unique(fields.bodies):
        cells = fields.cells[fields.bodies == body]
        marks.append(
            ColourField(
                points=points, triangles=triangles(cells), values=stress,
                scale=scale or _PLAIN,
            )
        )  # fmt: skip
        if len(fields.cells) <= _MESH_SHOWN:
            ends = points[edges(cells)]
            marks.append(
                Strokes(
                    ends=ends, colour="white", width=0.25, opacity=0.35, rasterised=True
                )
            )
    return marks


def triangles(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Halve quadrilaterals, keep triangles: node numbers (t, 3)."""
    halves = cells[cells[:, 2] != cells[:, 3]]
    return np.vstack([cells[:, [0, 1, 2]], halves[:, [0, 2, 3]]])


def edges(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Every edge of cells once, (k, 2) node numbers."""
    edges: NDArray[np.int64] = np.unique(np.sort(_sides(cells), axis=1), axis=0)
    return edges


def _sides(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """List the directed sides of every cell, (s, 2) node numbers."""
    sides = np.stack([cells, np.roll(cells, -1, axis=1)], axis=2).reshape(-1, 2)
    return np.asarray(sides[sides[:, 0] != sides[:, 1]])


def outlines(cells: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Follow the sides that belong to one cell only to closed loops of node numbers."""
    sides = _sides(cells)
    _, back, count = np.unique(
        np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    following: dict[int, list[int]] = {}
    for start, end in sides[count[back.ravel()] == 1].tolist():
        following.setdefault(start, []).append(end)
    loops = []
    while following:
        loop = [next(iter(following))]
        while loop[-1] in following:
            ends = following[loop[-1]]
            step = ends.pop()
            if not ends:
                del following[loop[-1]]
            loop.append(step)
        loops.append(np.array(loop))
    return loops


def _loaded(fields: Fields) -> tuple[Points, Points]:
    """Places of the loaded contact nodes, and the forces on them, N/m."""
    assert fields.contact_nodes is not None
    assert fields.contact_forces is not None
    size = np.hypot(*fields.contact_forces.T)
    active = size > _ACTIVE * size.max()
    return moved(fields)[fields.contact_nodes[active]], fields.contact_forces[active]


def _corners(fields: Fields) -> tuple[Vector, Vector]:
    """Lower left and upper right corner of the enlargement."""
    tips, _ = _loaded(fields)
    low, high = _box(fields)
    span = float((high - low).max())
    middle = (tips.min(axis=0) + tips.max(axis=0)) / 2
    reach = max(0.75 * float(np.ptp(tips, axis=0).max()), 0.06 * span)
    half = np.array([reach, _FLAT * reach])
    return middle - half, middle + half


def _enlarged(fields: Fields, bodies: Sequence[FieldMark]) -> FieldPanel:
    """Zoom to the loaded contact nodes and show the force on each as an arrow."""
    tips, forces = _loaded(fields)
    low, high = _corners(fields)
    largest = float(np.hypot(*forces.T).max())
    drawn = 0.4 * (high - low)[1] / largest * forces
    arrows = Vectors(
        feet=tips - drawn, vectors=drawn, width=0.0032 if len(tips) < 25 else 0.002,
        colour=_ARROW, cased=True,
    )  # fmt: skip
    factor, prefix = _prefixed(largest)
    return FieldPanel(
        low=_pair(low), high=_pair(high), marks=(*bodies, arrows), axes="frame",
        title="(b) contact forces on the slave nodes; the largest is "
        f"{largest / factor:.3g} {prefix}N/m",
        xlabel="$x$ in m", ylabel="$y$ in m",
    )  # fmt: skip


def _frame(fields: Fields, least: Vector, most: Vector) -> tuple[FieldMark, ...]:
    """Outline the enlargement in the overview."""
    low, high = _corners(fields)
    (x0, y0), (x1, y1) = np.maximum(low, least), np.minimum(high, most)
    corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
    return (
        Polygons(corners=(corners,), edge=_ARROW, width=0.8, cased=True),
        Label(
            text="(b)", place=_pair(corners[2]), offset=(3, 0), align=("left", "top"),
            colour=_ARROW, cased=True,
        ),
    )  # fmt: skip
