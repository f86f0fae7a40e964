"""Deformed bodies: mesh, outlines, stress and contact forces."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import ContactSide, Fields, InputError, Vector
from mortarbench.harness.mechanics import boundary_facets
from mortarbench.harness.plugin import SLIDING
from mortarbench.reports.figures.fields import (
    Arrow,
    ColourField,
    ColourScale,
    FieldFigure,
    FieldMark,
    FieldPanel,
    Label,
    Look,
    Path,
    Points,
    Polygons,
    Strokes,
    Vectors,
)
from mortarbench.reports.figures.projection import (
    Camera,
    camera_above,
    camera_seeing,
    camera_towards,
    crease_edges,
    face_normals,
    visible_faces,
)
from mortarbench.reports.figures.style import INK

#: Percentile of the nodal stresses at which the colour scale ends. The maximum is not
#: used, because stresses may be singular at corners.
PERCENTILE = 99.5
SCALE = 1.0  #: factor of the displacement in figures drawn to scale
#: Displacements below `SEEN` times the size of the bodies count as invisible. They are
#: magnified such that the largest is at most `SHOWN` times that size.
SEEN, SHOWN = 0.01, 0.05
#: largest number of cells for which mesh lines are drawn; more would hide the colours
_MESH_SHOWN = 6000
_ACTIVE = (
    1e-6  #: fraction of the largest force above which a contact node counts as loaded
)
_LENGTHS = ((1.0, "m"), (1e-3, "mm"), (1e-6, "µm"))  #: units of axes
#: colour of frames, letters, and arrows of frictionless pairs; dark even on dark pages,
#: because they are drawn on coloured bodies
_ARROW = "#101214"
#: colours of arrows by friction state; arrows of frictionless pairs are dark
FRICTION = {
    "stick": ("#0b5fa5", "blue"),
    "slip": ("#b3261e", "red"),
    SLIDING: ("#e08a00", "orange"),
}
_TOUCHING = ("", "stick", "slip")  #: states of nodes under pressure
_BAND = 2.2  #: width of the line along nodes that slide without contact, points
_WIDTH = 5.62  #: width of the panels without colour bar and label, inches
_TALLEST = 7.5  #: largest height of the panel of all bodies, inches
_FLAT = 0.34  #: ratio of height to width of an enlargement
_PLAIN = ColourScale(colours="Greys", low=0, high=1)
#: font size of subdomain numbers → largest number of subdomains; the labels of more
#: subdomains would overlap
_NUMBERED = {9.5: 16, 6.5: 100}
_SUBDOMAIN = Look(colour="white", width=0.9)  #: borders of subdomains
#: colour of arrows at open nodes, which carry a part of the force on adjacent nodes
_OPEN = "#6b7480"
_STATES = FRICTION | {"open": (_OPEN, "grey")}
_OUTLINE = Look(colour=INK, width=0.7)
_ALONG = 0.9  #: cosine of the angle to an axis above which normals count as parallel
_MARGIN = 0.03  #: margin around arrows at the edge of a panel, relative to its size
_CREASE = np.radians(40)  #: smallest angle between faces whose common edge is outlined
_BEFORE = Look(colour="#8a93a0", width=0.7, dash=(4, 2.5))


def clipped_at(fields: Fields) -> tuple[float, float] | None:
    """Return the end of the colour scale and the largest stress, Pa.

    Return None if the fields contain no stress.
    """
    stress = fields.nodal.get("von_mises")
    if stress is None:
        return None
    return float(np.percentile(stress, PERCENTILE)), float(np.max(stress))


class _Loaded(NamedTuple):
    """Slave nodes of one contact pair that carry a force or slide without contact."""

    name: str  #: name of the pair; empty if the fields do not distinguish pairs
    nodes: NDArray[np.int64]  #: (k,)
    forces: Points  #: contact forces on the slave nodes, N/m
    friction: NDArray[np.str_]  #: (k,) states of `ContactSide`; "" without friction
    #: (j, 2) pairs of adjacent nodes; the first node of a pair slides without contact
    sliding: NDArray[np.int64]

    @property
    def closed(self) -> NDArray[np.bool_]:
        """(k,) mask of nodes under pressure; others may carry shear (Tresca's law)."""
        touching = np.isin(self.friction, _TOUCHING)
        return touching if touching.any() else ~touching


def automatic_scale(fields: Fields) -> float:
    """Return a magnification of the displacement: 1, 2 or 5 times a power of ten.

    Displacements that are visible without magnification are drawn to scale.
    """
    largest = float(np.abs(fields.displacement).max(initial=0.0))
    span = float(np.ptp(fields.points, axis=0).max())
    if largest == 0 or largest >= SEEN * span:
        return SCALE
    target = SHOWN * span / largest
    power = 10.0 ** np.floor(np.log10(target))
    if not np.isfinite(power):  # displacements that are zero up to rounding
        return SCALE
    return float(max(step * power for step in (1, 2, 5) if step * power <= target))


def deformed_figure(fields: Fields, scale: float | None = None) -> FieldFigure:
    """Draw all bodies, and an enlargement of each contact under load.

    In 3D, draw the surface of the bodies, and the pressure on each loaded contact side.

    scale : magnification of the displacement; None: `automatic_scale`

    Raises
    ------
    InputError
        If displacement or stress is not finite, or the bodies have zero extent.

    """
    shown = (fields.displacement, fields.nodal.get("von_mises", 0.0))
    if not all(np.isfinite(values).all() for values in shown):
        raise InputError(
            "displacement or stress contains NaN or inf; expected finite values"
        )
    if not np.ptp(fields.points, axis=0).all():
        raise InputError("bodies have no width or no height and cannot be drawn")
    scale = automatic_scale(fields) if scale is None else scale
    if fields.dim == 3:
        return _figure_in_space(fields, scale)
    points = moved(fields, scale)
    loaded = _loaded(fields)
    both = np.vstack([fields.points, points])
    low, high = both.min(axis=0), both.max(axis=0)
    width, height = high - low
    pad = 0.02 * width
    drawn = min(_WIDTH * (height + 2 * pad) / (width + 2 * pad), _TALLEST)
    enlarged = _WIDTH * _FLAT
    colours = _scale(fields)
    bodies = _bodies(fields, points, colours)
    before, after = (
        [Path(points=at[loop], look=style) for loop in outlines(fields.cells)]
        for at, style in ((fields.points, _BEFORE), (points, _OUTLINE))
    )
    corners = low - pad, high + pad
    span = float((high - low).max())
    letters = [f"({chr(ord('b') + i)})" for i in range(len(loaded))]
    # outlines of the enlargements, clipped to the overview
    frames = list[FieldMark]()
    for letter, contact in zip(letters, loaded, strict=True):
        window = _window(points[contact.nodes[contact.closed]], span)
        (x0, y0), (x1, y1) = (
            within(one, other)
            for within, one, other in zip(
                (np.maximum, np.minimum), window, corners, strict=True
            )
        )
        at = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
        frames += [
            Polygons(corners=(at,), edge=_ARROW, width=0.8, cased=True),
            Label(
                text=letter,
                place=_pair(at[2]),
                offset=(3, 0),
                align=("left", "top"),
                colour=_ARROW,
                cased=True,
            ),
        ]
    bands = [mark for contact in loaded for mark in _bands(contact, points)]
    there = moved(fields)  # not magnified: magnified bodies would overlap in contact
    near = (
        *_bodies(fields, there, colours),
        *(Path(points=there[o], look=_OUTLINE) for o in outlines(fields.cells)),
    )
    truly = "" if scale == SCALE else f"displacement × {SCALE:g}"
    overview = FieldPanel(
        low=_pair(corners[0]),
        high=_pair(corners[1]),
        marks=(*bodies, *_subdomains(fields, points), *before, *after, *bands, *frames),
        title=f"{'(a) ' if loaded else ''}deformed bodies, displacement × {scale:g}; "
        "dashed: undeformed",
        **_axes(span),
    )
    windows = []
    for letter, contact in zip(letters, loaded, strict=True):
        words = ", ".join(filter(None, (contact.name, truly)))
        title = f"{letter} {words}: " if words else f"{letter} "
        marks, tips = (*near, *_bands(contact, there)), there[contact.nodes]
        windows.append(_enlarged(marks, title, contact, tips, span))
    return FieldFigure(
        panels=(overview, *windows),
        height=drawn + 0.55 + len(windows) * (enlarged + 0.69),
        heights=(drawn, *[enlarged] * len(windows)),
        scale=colours,
    )


def _figure_in_space(fields: Fields, scale: float) -> FieldFigure:
    """Draw the surface of solids, and the pressure on each loaded contact side.

    Several bodies are seen from above, since sides between them are hidden from every
    direction. A single body is seen from the side that touches a rigid body.
    """
    faces = boundary_facets(fields.cells, 3)
    sides = [
        (side, faces[np.isin(faces, side.nodes).all(axis=1)])
        for side in fields.contacts
        if side.pressure.max(initial=0.0) > 0
    ]
    sides = [(side, own) for side, own in sides if len(own)]
    normals = [face_normals(fields.points, own).sum(axis=0) for _, own in sides]
    normals = [normal / np.linalg.norm(normal) for normal in normals]
    is_single = np.unique(fields.bodies).size == 1
    towards = camera_seeing if is_single else camera_above
    camera = towards(normals[0] if normals else np.zeros(3))
    points = moved(fields, scale)
    span = float(np.ptp(np.vstack([fields.points, points]), axis=0).max())
    colours = _scale(fields)
    stress = np.full(len(points), 0.3) if colours is None else fields.nodal["von_mises"]
    shown = visible_faces(
        camera,
        points,
        faces,
        stress,
        colours or _PLAIN,
        mesh=len(faces) <= _MESH_SHOWN,
    )
    before = crease_edges(camera, fields.points, faces, _CREASE)
    outlines = [Path(points=ends, look=_BEFORE) for ends in before]
    both = np.vstack([shown.corners.reshape(-1, 2), before.reshape(-1, 2)])
    low, high = both.min(axis=0), both.max(axis=0)
    low, high = low - 0.12 * (high - low).max(), high + 0.02 * (high - low)
    letters = iter("abcdefghijklmnopqrstuvwxyz")
    panels = [
        FieldPanel(
            low=_pair(low),
            high=_pair(high),
            axes="none",
            scale=colours,
            marks=(*outlines, shown, *_triad(camera, low, high)),
            title=f"({next(letters)}) displacement × {scale:g}; dashed: undeformed",
        )
    ]
    for (side, own), normal in zip(sides, normals, strict=True):
        panels.append(_pressure_panel(fields, side, own, normal, next(letters), span))
    rows = -(-len(panels) // 2)
    return FieldFigure(
        panels=tuple(panels),
        columns=min(len(panels), 2),
        height=3.9 * rows,
        heights=(1.0,) * rows,
    )


def _pressure_panel(
    fields: Fields,
    side: ContactSide,
    faces: NDArray[np.int64],
    normal: Vector,
    letter: str,
    span: float,
) -> FieldPanel:
    """Draw the pressure on the undeformed faces of a side, seen along its mean normal.

    If this normal is nearly parallel to an axis, the side is seen along that axis, and
    positive axes point to the right.
    """
    camera = camera_towards(
        np.where(np.abs(normal).max() > _ALONG, np.rint(normal), normal)
    )
    if camera.right.sum() < 0:  # seen through the body
        camera = camera._replace(right=-camera.right)
    pressure = np.zeros(len(fields.points))
    pressure[side.nodes] = side.pressure
    largest = float(side.pressure.max())
    factor, prefix = prefixed(largest)
    colours = ColourScale(
        colours="inferno",
        low=0,
        high=largest,
        unit=factor,
        label=f"contact pressure in {prefix}Pa",
    )
    shown = visible_faces(
        camera, fields.points, faces, pressure, colours, mesh=len(faces) <= _MESH_SHOWN
    )
    pressed = side.nodes[side.pressure > _ACTIVE * largest]
    places = camera.project(fields.points[pressed])
    low, high = places.min(axis=0), places.max(axis=0)
    half = 0.65 * float((high - low).max()) or 0.1 * span
    corners = shown.corners.reshape(-1, 2)
    middle = (low + high) / 2
    low = np.maximum(middle - half, corners.min(axis=0))
    high = np.minimum(middle + half, corners.max(axis=0))
    unit, name = length_unit(float((high - low).max()))
    labels = [_axis_name(axis, name) for axis in (camera.right, camera.up)]
    size = float((high - low).max())
    arrows, key = _friction_arrows(fields, side, camera, size)
    if arrows:  # extend the panel, so that its frame does not cut off arrows
        ends = [(mark.feet, mark.feet + mark.vectors) for mark in arrows]
        shown_ends = np.vstack([*itertools.chain(*ends), low, high])
        low = shown_ends.min(axis=0) - _MARGIN * size
        high = shown_ends.max(axis=0) + _MARGIN * size
    return FieldPanel(
        low=_pair(low),
        high=_pair(high),
        marks=(shown, *arrows),
        scale=colours,
        unit=unit,
        xlabel=labels[0],
        ylabel=labels[1],
        title=f"({letter}) {side.name}{key}",
    )


def _friction_arrows(
    fields: Fields, side: ContactSide, camera: Camera, span: float
) -> tuple[list[Vectors], str]:
    """Return arrows of the shear on slave nodes, and text with counts of their states.

    span : size of the panel, m
    """
    if side.friction is None or side.friction_force is None:
        return [], ""
    area = np.where(side.length > 0, side.length, np.inf)[:, None]
    traction = side.friction_force / area
    sizes = np.linalg.norm(traction, axis=1)
    largest = float(sizes.max(initial=0.0))
    drawn = 0.12 * span / (largest or 1.0) * camera.project(traction)
    feet, acts = camera.project(fields.points[side.nodes]), sizes > _ACTIVE * largest
    arrows = [
        Vectors(
            feet=feet[of], vectors=drawn[of], colour=colour, width=0.006, cased=True
        )
        for state, (colour, _) in FRICTION.items()
        if (of := acts & (side.friction == state)).any()
    ]
    factor, prefix = prefixed(largest)
    return arrows, (
        f"\narrows: friction on the slave, at most {largest / factor:.3g} {prefix}Pa"
        f"\n{_states(side.friction)}"
    )


def _axis_name(direction: Vector, unit: str) -> str:
    """Return the label of an axis of a picture, with its name if along x, y or z."""
    axis = int(np.abs(direction).argmax())
    is_along = direction[axis] > 1 - 1e-9
    return f"${'xyz'[axis]}$ in {unit}" if is_along else f"in {unit}"


def _triad(camera: Camera, low: Vector, high: Vector) -> list[FieldMark]:
    """Draw the directions of x, y and z in the lower left corner."""
    size = 0.11 * float((high - low).max())
    tips = camera.project(size * np.eye(3))
    origin = low + size * 0.2 - np.minimum(tips.min(axis=0), 0)
    marks: list[FieldMark] = []
    for tip, name in zip(tips, "xyz", strict=True):
        marks.append(
            Arrow(start=_pair(origin), end=_pair(origin + tip), head="-|>", size=6)
        )
        marks.append(
            Label(
                text=f"${name}$",
                place=_pair(origin + 1.25 * tip),
                align=("center", "center"),
            )
        )
    return marks


def moved(fields: Fields, scale: float = SCALE) -> Points:
    """Return the nodes displaced by `scale` times the displacement, (n, dim)."""
    return cast(Points, fields.points + scale * fields.displacement)


def _subdomains(fields: Fields, points: Points) -> list[FieldMark]:
    """Outline subdomains of the bodies; number them if the labels are legible."""
    if fields.subdomains is None:
        return []
    numbers = np.unique(fields.subdomains)
    size = next((s for s, most in _NUMBERED.items() if numbers.size <= most), None)
    marks: list[FieldMark] = []
    for number in numbers:
        cells = fields.cells[fields.subdomains == number]
        marks += [
            Path(points=points[loop], look=_SUBDOMAIN) for loop in outlines(cells)
        ]
        if size is not None:
            centres = points[cells].mean(axis=1)
            middle = np.linalg.norm(centres - centres.mean(axis=0), axis=1).argmin()
            place = _pair(centres[middle])  # the centroid may be outside the subdomain
            marks.append(
                Label(
                    text=f"{number}",
                    place=place,
                    align=("center", "center"),
                    colour=_ARROW,
                    cased=True,
                    size=size,
                )
            )
    return marks


def _pair(point: Vector) -> tuple[float, float]:
    return float(point[0]), float(point[1])


def _scale(fields: Fields) -> ColourScale | None:
    """Return the stress scale in Pa of all bodies; None if the stress is unknown."""
    limits = clipped_at(fields)
    if limits is None:
        return None
    clipped, largest = limits
    factor, prefix = prefixed(clipped)
    return ColourScale(
        colours="viridis",
        low=0,
        high=clipped or 1.0,
        unit=factor,
        label=f"von Mises stress in {prefix}Pa",
        beyond="max" if largest > clipped else "neither",
    )


def prefixed(value: float) -> tuple[float, str]:
    """Return factor and prefix (G, M, k or none) of the largest unit up to `value`."""
    prefixes = ((1e9, "G"), (1e6, "M"), (1e3, "k"))
    return next((p for p in prefixes if value >= p[0]), (1.0, ""))


def _bodies(
    fields: Fields, points: Points, scale: ColourScale | None
) -> list[FieldMark]:
    """Draw stress and mesh of every deformed body."""
    stress = np.full(len(points), 0.3) if scale is None else fields.nodal["von_mises"]
    marks: list[FieldMark] = []
    for body in np.unique(fields.bodies):
        cells = fields.cells[fields.bodies == body]
        marks.append(
            ColourField(
                points=points,
                triangles=triangles(cells),
                values=stress,
                scale=scale or _PLAIN,
            )
        )
        if len(fields.cells) <= _MESH_SHOWN:
            ends = points[edges(cells)]
            marks.append(
                Strokes(
                    ends=ends, colour="white", width=0.25, opacity=0.35, rasterised=True
                )
            )
    return marks


def triangles(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Split quadrilaterals into triangles; return their node numbers (t, 3)."""
    halves = cells[cells[:, 2] != cells[:, 3]]
    return np.vstack([cells[:, [0, 1, 2]], halves[:, [0, 2, 3]]])


def edges(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the distinct edges of cells, (k, 2) node numbers."""
    edges: NDArray[np.int64] = np.unique(np.sort(_sides(cells), axis=1), axis=0)
    return edges


def _sides(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the directed sides of all cells, (s, 2) node numbers."""
    sides = np.stack([cells, np.roll(cells, -1, axis=1)], axis=2).reshape(-1, 2)
    return np.asarray(sides[sides[:, 0] != sides[:, 1]])


def outlines(cells: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Return the boundary of cells as closed loops of node numbers."""
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


def length_unit(span: float) -> tuple[float, str]:
    """Return the size in m and the name of a unit suitable for a length: m, mm, µm."""
    return next((u for u in _LENGTHS if span >= 0.1 * u[0]), _LENGTHS[-1])


def _axes(span: float) -> dict[str, Any]:
    """Return labels and unit of the axes for bodies of size `span`, m."""
    unit, name = length_unit(span)
    return {"xlabel": f"$x$ in {name}", "ylabel": f"$y$ in {name}", "unit": unit}


def _loaded(fields: Fields) -> list[_Loaded]:
    """List the contacts under load; a single item if the fields do not name pairs."""
    sides = [
        (side.name, side.nodes, side.force, side.friction) for side in fields.contacts
    ]
    if not sides and fields.contact_nodes is not None:
        assert fields.contact_forces is not None
        sides = [("", fields.contact_nodes, fields.contact_forces, None)]
    contacts = []
    for name, nodes, forces, friction in sides:
        # nodes without a contact row may carry a part of the force on adjacent nodes
        states = (
            np.full(len(nodes), "")
            if friction is None
            else np.where(friction == "", "open", friction)
        )
        size, apart = np.hypot(*forces.T), states == SLIDING
        active = size > _ACTIVE * size.max(initial=0.0)
        if active.any():
            active |= apart
            pairs = np.column_stack([nodes[:-1], nodes[1:]])
            sliding = np.vstack([pairs[apart[:-1]], pairs[apart[1:]][:, ::-1]])
            contacts.append(
                _Loaded(name, nodes[active], forces[active], states[active], sliding)
            )
    return contacts


def _bands(contact: _Loaded, points: Points) -> list[FieldMark]:
    """Draw lines along nodes that slide without contact, whose arrows are short."""
    if not len(contact.sliding):
        return []
    at, beside = points[contact.sliding[:, 0]], points[contact.sliding[:, 1]]
    ends = np.stack([at, (at + beside) / 2], axis=1)
    return [Strokes(ends=ends, colour=FRICTION[SLIDING][0], width=_BAND)]


def _window(places: Points, span: float) -> tuple[Vector, Vector]:
    """Return the lower left and upper right corners of an enlargement.

    span : size of all bodies, m
    """
    low, high = places.min(axis=0), places.max(axis=0)
    reach = max(0.75 * float((high - low).max()), 0.06 * span)
    half = np.array([reach, _FLAT * reach])
    return (low + high) / 2 - half, (low + high) / 2 + half


def _enlarged(
    bodies: Sequence[FieldMark], title: str, contact: _Loaded, tips: Points, span: float
) -> FieldPanel:
    """Enlarge a contact and show the force on each loaded node as an arrow."""
    forces, closed = contact.forces, contact.closed
    low, high = _window(tips[closed], span)
    shown = closed | ((tips >= low) & (tips <= high)).all(axis=1)
    largest = float(np.hypot(*forces.T).max())
    drawn = 0.4 * (high - low)[1] / largest * forces
    colours = _STATES | {"": (_ARROW, "dark")}
    thick = 0.0032 if closed.sum() < 25 else 0.002
    arrows = [
        Vectors(
            feet=(tips - drawn)[of],
            vectors=drawn[of],
            width=thick if state in _TOUCHING else 0.4 * thick,
            cased=state in _TOUCHING,
            colour=colours[state][0],
        )
        for state in sorted(set(contact.friction), key=lambda s: (s in _TOUCHING, s))
        if (of := shown & (contact.friction == state)).any()
    ]
    key = f"\n{_states(contact.friction)}" if contact.friction.any() else ""
    factor, prefix = prefixed(largest)
    return FieldPanel(
        low=_pair(low),
        high=_pair(high),
        marks=(*bodies, *arrows),
        axes="frame",
        title=f"{title}contact forces on the slave nodes, largest "
        f"{largest / factor:.3g} {prefix}N/m{key}",
        **_axes(span),
    )


def _states(friction: NDArray[np.str_]) -> str:
    """Count the nodes in each friction state; name the colour of their arrows."""
    counts = {state: int((friction == state).sum()) for state in _STATES}
    return ", ".join(
        f"{state}: {_STATES[state][1]} ({count})"
        for state, count in counts.items()
        if count or state in _TOUCHING
    )
