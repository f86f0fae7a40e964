"""The contact seen closely: pressures along the arc, active nodes, both methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mortarbench.harness import Fields, Vector
from mortarbench.harness.files.experiment import Row
from mortarbench.reports.document import figure
from mortarbench.reports.document.fields import (
    Arrow,
    FieldFigure,
    FieldMark,
    FieldPanel,
    Label,
    Path,
    Points,
    Polygons,
    Vectors,
)
from mortarbench.reports.document.figure import (
    INK,
    Axis,
    ColourBar,
    Figure,
    Key,
    Legend,
    Look,
    Numbers,
    Panel,
    Series,
    limits,
)
from mortarbench.reports.figures.deformed import moved
from mortarbench.reports.figures.style import COLOURS, below, log, look
from mortarbench.reports.paper.geometry import mesh

ACTIVE = 1e-6  #: a node is in contact if its force exceeds this times the largest
CONTACTS = {  #: of the tables → as the figures call them
    "nts": "node-to-segment, the paper's",
    "mortar": "mortar, dual basis",
    "mortar-standard": "mortar, standard basis",
}
EXACT = 1e-12  #: relative errors below are rounding, and drawn there
_PRESSURE = "contact pressure in GPa"
#: of node-to-segment and mortar
_LOOKS = {"nts": look(0), "mortar": replace(look(1), fill="none")}
#: viridis without its ends: one is lost on a dark page, the other on a white one
_RAMP = ("3b528b", "31678e", "297b8e", "218f8d", "1fa287", "32b67a", "56c667", "86d549",
         "bddf26")  # fmt: skip


def active(rows: Sequence[Row], contact: str) -> dict[int, list[Row]]:
    """Step → the rows of the nodes that are in contact."""
    mine = [r for r in rows if r["contact"] == contact]
    steps = sorted({int(r["step"]) for r in mine})
    largest = max(float(r["force"]) for r in mine)
    return {
        step: [
            r for r in mine
            if r["step"] == step and float(r["force"]) > ACTIVE * largest
        ]
        for step in steps
    }  # fmt: skip


def pressure_figure(rows: Sequence[Row]) -> Figure:
    """Draw pressure against arc angle, and the active set, over the load steps."""
    low, high = _span(rows)
    angle = Axis(label="arc angle in degrees", low=low, high=high)
    steps, end = _through_the_steps(rows, angle), _at_the_end(rows, angle)
    nodes = replace(_active_set(rows, angle), span=2)
    keys = [
        Key(label=CONTACTS[contact], look=style)
        for contact, style in _active_looks().items()
    ]
    return Figure(
        rows=(
            figure.Row(panels=(steps, end)),
            figure.Row(panels=(nodes,), height=0.85),
        ),
        height=5.6,
        legend=below(keys, 2),
    )


def _span(rows: Sequence[Row]) -> tuple[float, float]:
    """Find the arc that is ever in contact, and two nodes more on either side."""
    touched = [
        float(r["angle"])
        for contact in ("nts", "mortar")
        for loaded in active(rows, contact).values()
        for r in loaded
    ]
    angles = sorted({float(r["angle"]) for r in rows})
    margin = 2 * (angles[1] - angles[0])
    return min(touched) - margin, max(touched) + margin


def _profile(
    rows: Sequence[Row], contact: str, step: int, angle: Axis
) -> tuple[Numbers, Numbers]:
    """Angles within the axis, ascending, and pressures in GPa."""
    assert angle.low is not None
    assert angle.high is not None
    points = sorted(
        (float(r["angle"]), float(r["pressure"]) / 1e9)
        for r in rows
        if r["contact"] == contact and r["step"] == step
        and angle.low <= float(r["angle"]) <= angle.high
    )  # fmt: skip
    angles, pressures = zip(*points, strict=True)
    return angles, pressures


def _through_the_steps(rows: Sequence[Row], angle: Axis) -> Panel:
    colours = _ramp(max(int(r["step"]) for r in rows))
    marks = []
    for step, colour in enumerate(colours, 1):
        x, p = _profile(rows, "nts", step, angle)
        marks.append(Series(x=x, y=p, look=Look(colour=colour, width=1.0)))
    return Panel(
        x=angle, y=Axis(label=_PRESSURE, low=0), marks=tuple(marks),
        title="(a) node-to-segment, all load steps",
        bar=ColourBar(label="load step", colours=colours),
    )  # fmt: skip


def _ramp(count: int) -> tuple[str, ...]:
    """Choose so many colours, evenly along the ramp."""
    known = np.array([list(bytes.fromhex(name)) for name in _RAMP])
    at = np.linspace(0, len(_RAMP) - 1, count)
    mixed = [np.interp(at, np.arange(len(_RAMP)), channel) for channel in known.T]
    parts = np.round(np.transpose(mixed)).astype(np.uint8)
    return tuple(f"#{bytes(colour).hex()}" for colour in parts)


def _at_the_end(rows: Sequence[Row], angle: Axis) -> Panel:
    last = max(int(r["step"]) for r in rows)
    marks, keys = [], []
    for (contact, style), size in zip(_LOOKS.items(), (4, 3), strict=True):
        x, p = _profile(rows, contact, last, angle)
        shown = replace(style, size=size)
        marks.append(Series(x=x, y=p, look=shown))
        keys.append(Key(label=CONTACTS[contact], look=shown))
    panel = Panel(
        x=angle, y=Axis(label=_PRESSURE), marks=tuple(marks),
        title=f"(b) both methods, load step {last}",
        legend=Legend(keys=tuple(keys), place="upper left", size=8.5),
    )  # fmt: skip
    _, high = limits([panel], "y")
    return replace(panel, y=replace(panel.y, low=0, high=1.3 * high))


def _active_looks() -> dict[str, Look]:
    sizes = zip(_LOOKS.items(), (3.4, 6.2), strict=True)
    return {
        contact: replace(style, size=size, edge=0.7, dash=None)
        for (contact, style), size in sizes
    }


def _active_set(rows: Sequence[Row], angle: Axis) -> Panel:
    marks = []
    for contact, style in _active_looks().items():
        found = [
            (float(r["angle"]), float(step))
            for step, loaded in active(rows, contact).items()
            for r in loaded
        ]
        x, y = zip(*found, strict=True)
        marks.append(Series(x=x, y=y, look=style))
    last = max(int(r["step"]) for r in rows)
    steps = Axis(
        label="load step", low=0.3, high=last + 0.7, most=min(last, 10), integers=True
    )
    title = "(c) active set: the nodes in contact"
    return Panel(x=angle, y=steps, marks=tuple(marks), title=title)


def zoom_figure(fields: Fields) -> FieldFigure:
    """Show the bodies where they touch: mesh, pressures along their normals."""
    assert fields.contact_nodes is not None
    assert fields.contact_forces is not None
    points = moved(fields)
    arc = points[fields.contact_nodes]
    size = np.hypot(*fields.contact_forces.T)
    loaded = size > ACTIVE * size.max()
    normal = -fields.contact_forces[loaded] / size[loaded, None]
    pressure = size[loaded] / _lengths(fields)[loaded]
    reach = float(np.ptp(arc[loaded], axis=0).max())
    scale = 0.3 * reach / float(pressure.max())
    tips = arc[loaded] + scale * pressure[:, None] * normal
    both = np.vstack([arc[loaded], tips])
    x0, y0 = (both.min(axis=0) - 0.18 * reach).tolist()
    x1, y1 = (both.max(axis=0) + 0.1 * reach).tolist()
    corner = x0 + 0.05 * reach, y0 + 0.05 * reach
    panel = FieldPanel(
        low=(x0, y0), high=(x1, y1),
        marks=(
            *mesh(fields, points, 0.9), *_pressures(arc[loaded], tips),
            *_scale_bar(*corner, scale, float(pressure.max())),
        ),
        xlabel="$x$ in m", ylabel="$y$ in m", axes="frame",
    )  # fmt: skip
    return FieldFigure(panels=(panel,), height=4.1)


def _lengths(fields: Fields) -> Vector:
    """Return the length of undeformed arc that belongs to each slave node, m."""
    assert fields.contact_nodes is not None
    chain = fields.points[fields.contact_nodes]
    half = np.linalg.norm(np.diff(chain, axis=0), axis=1) / 2
    lengths: Vector = np.append(half, 0) + np.append(0, half)
    return lengths


def _pressures(feet: Points, tips: Points) -> list[FieldMark]:
    """Make each pressure along the normal of its node, and their envelope."""
    colour = COLOURS[1]
    outline = np.vstack([feet, tips[::-1]])
    dots = Look(colour=INK, marker="o", size=2.4, dash=None)
    return [
        Polygons(corners=(outline,), fill=colour, opacity=0.18),
        Path(points=tips, look=Look(colour=colour, width=1.2)),
        Vectors(feet=feet, vectors=tips - feet, colour=colour, width=0.0022),
        Path(points=feet, look=dots),
    ]


def _scale_bar(x: float, y: float, scale: float, largest: float) -> list[FieldMark]:
    """State the scale of the pressures by an arrow of a round size."""
    unit = float(f"{largest / 2:.0e}")
    text = f"pressure {unit / 1e9:g} GPa"
    return [
        Arrow(
            start=(x, y), end=(x, y + scale * unit), head="-|>", width=1.2,
            colour=COLOURS[1],
        ),
        Label(text=text, place=(x, y + scale * unit / 2), offset=(6, 0)),
    ]  # fmt: skip


def verification_figure(rows: Sequence[Row]) -> Figure:
    """Draw the errors against exact solutions over the mesh."""
    titles = {
        "patch": ("patch test", "elements along the block", "largest stress error"),
        "hertz": ("Hertz contact", "elements per half width", "$L^2$ pressure error"),
    }
    looks = (look(0), look(1), replace(look(2), size=7, fill="none"))
    panels = []
    for letter, (problem, (title, size, error)) in zip(
        "ab", titles.items(), strict=True
    ):
        marks = []
        for contact, style in zip(CONTACTS, looks, strict=True):
            points = sorted(
                (float(r["n"]), max(float(r["error"]), EXACT)) for r in rows
                if r["problem"] == problem and r["contact"] == contact
            )  # fmt: skip
            x, y = zip(*points, strict=True)
            marks.append(Series(x=x, y=y, look=style))
        axis = log(f"{error}, relative")
        if problem == "patch":
            axis = replace(axis, low=EXACT / 10, high=10)
        panels.append(
            Panel(x=log(size), y=axis, marks=tuple(marks), title=f"({letter}) {title}")
        )
    keys = [
        Key(label=name, look=style)
        for name, style in zip(CONTACTS.values(), looks, strict=True)
    ]
    return Figure(
        rows=(figure.Row(panels=tuple(panels)),), height=3.2, legend=below(keys, 3)
    )
