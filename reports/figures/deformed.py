"""Pictures of deformed bodies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import colormaps, patheffects, rc_context
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.tri import Triangulation
from numpy.typing import NDArray

from harness import Fields, InputError, Vector
from reports.figures.saving import save
from reports.figures.style import INK, STYLE

PERCENTILE = 99.5  #: where colours are clipped: stresses are singular at corners
SCALE = 1.0  #: of the displacement: the bodies are where the computation puts them
_MESH_SHOWN = 6000  #: cells; the lines of a finer mesh would hide the colours
_MAP = colormaps["viridis"]
_ACTIVE = 1e-6  #: a contact node is loaded if its force exceeds this times the largest
_CASING: list[patheffects.AbstractPathEffect] = [
    patheffects.withStroke(linewidth=1.6, foreground="white")
]
_ARROW = "#101214"  #: dark on every page: arrows stand on the bodies' colours
_WIDTH = 5.62  #: of the panels, inches, beside the colour bar and its label
_TALLEST = 7.5  #: inches, of the panel of tall bodies
_FLAT = 0.34  #: height over width of the enlargement


def draw_deformed(fields: Fields, path: Path) -> None:
    """Draw the deformed bodies with their von Mises stress to a png, pdf or svg file.

    Raises
    ------
    InputError
        When the ending is none of these, or the displacement is not finite.

    """
    if path.suffix not in {".png", ".pdf", ".svg"}:
        raise InputError(
            f"{path}: unknown kind of picture {path.suffix!r}; known: .pdf, .png, .svg"
        )
    save(deformed_figure(fields), path)


def clipped_at(fields: Fields) -> tuple[float, float] | None:
    """Say where the colours end and the largest stress, Pa; None without stress."""
    stress = fields.nodal.get("von_mises")
    if stress is None:
        return None
    return float(np.percentile(stress, PERCENTILE)), float(np.max(stress))


def deformed_figure(fields: Fields) -> Figure:
    """Draw all bodies, and their contact enlarged where contact forces are given."""
    shown = (fields.displacement, fields.nodal.get("von_mises", 0.0))
    if not all(np.isfinite(values).all() for values in shown):
        raise InputError("displacement or stress holds NaN or inf: there is no picture")
    if not np.ptp(fields.points, axis=0).all():
        raise InputError("bodies of no width or no height: there is no picture")
    forces = fields.contact_forces
    loaded = forces is not None and bool(np.any(forces))
    with rc_context(STYLE):
        low, high = _box(fields)
        width, height = high - low
        pad = 0.02 * width
        drawn = min(_WIDTH * (height + 2 * pad) / (width + 2 * pad), _TALLEST)
        enlarged = _WIDTH * _FLAT if loaded else 0.0
        figure = Figure(figsize=(6.9, drawn + enlarged + (1.24 if loaded else 0.55)))
        ratios = [drawn, enlarged] if loaded else [drawn]
        panels = list(
            figure.subplots(len(ratios), 1, height_ratios=ratios, squeeze=False)[:, 0]
        )
        colours = _colours(fields)
        for axes in panels:
            _bodies(axes, fields, colours)
            axes.set(aspect="equal", xlabel="$x$ in m", ylabel="$y$ in m")
        panels[0].set(
            xlim=(low[0] - pad, high[0] + pad), ylim=(low[1] - pad, high[1] + pad)
        )
        for loop in outlines(fields.cells):
            style = {"color": "#8a93a0", "linewidth": 0.7, "dashes": (4, 2.5)}
            panels[0].plot(*fields.points[loop].T, zorder=1, **style)
        panels[0].set_title(
            f"{'(a) ' if loaded else ''}deformed bodies, displacement × {SCALE:g}; "
            "dashed: undeformed",
            loc="left",
        )
        if loaded:
            _enlarge(panels[1], panels[0], fields)
        if colours is not None:
            _bar(figure, panels, fields, colours)
    return figure


def _deformed(fields: Fields) -> NDArray[np.float64]:
    moved: NDArray[np.float64] = fields.points + SCALE * fields.displacement
    return moved


def _box(fields: Fields) -> tuple[Vector, Vector]:
    """Lower left and upper right corner of the bodies, before and after."""
    both = np.vstack([fields.points, _deformed(fields)])
    return both.min(axis=0), both.max(axis=0)


def _colours(fields: Fields) -> Normalize | None:
    """One scale in Pa, shared by all bodies."""
    limits = clipped_at(fields)
    return None if limits is None else Normalize(0, limits[0] or 1.0)


def _prefixed(value: float) -> tuple[float, str]:
    """Choose the unit prefix in which `value` is between 1 and 1000."""
    known = ((1e9, "G"), (1e6, "M"), (1e3, "k"))
    return next((p for p in known if value >= p[0]), (1.0, ""))


def _bodies(axes: Axes, fields: Fields, colours: Normalize | None) -> None:
    """Draw every body: stress, mesh and outline, deformed."""
    moved = _deformed(fields)
    for body in np.unique(fields.bodies):
        cells = fields.cells[fields.bodies == body]
        triangles = np.vstack([cells[:, [0, 1, 2]], cells[:, [0, 2, 3]]])
        mesh = Triangulation(moved[:, 0], moved[:, 1], triangles)
        stress = np.full(len(moved), 0.3)
        plain = Normalize(0, 1)
        axes.tripcolor(
            mesh,
            stress if colours is None else fields.nodal["von_mises"],
            cmap="Greys" if colours is None else _MAP,
            norm=plain if colours is None else colours,
            shading="gouraud",
            rasterized=True,
        )
        if len(fields.cells) <= _MESH_SHOWN:
            lines = LineCollection(
                list(moved[edges(cells)]), color="white", linewidth=0.25, alpha=0.35
            )
            lines.set_rasterized(True)
            axes.add_collection(lines)
    for loop in outlines(fields.cells):
        axes.plot(*moved[loop].T, color=INK, linewidth=0.7, zorder=3)


def edges(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Every edge of quadrilaterals once, (k, 2) node numbers."""
    edges: NDArray[np.int64] = np.unique(np.sort(_sides(cells), axis=1), axis=0)
    return edges


def _sides(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """List the four directed sides of every cell, (4E, 2) node numbers."""
    return np.stack([cells, np.roll(cells, -1, axis=1)], axis=2).reshape(-1, 2)


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


def _enlarge(axes: Axes, overview: Axes, fields: Fields) -> None:
    """Zoom to the loaded contact nodes and draw the force on each as an arrow."""
    assert fields.contact_nodes is not None
    assert fields.contact_forces is not None
    size = np.hypot(*fields.contact_forces.T)
    active = size > _ACTIVE * size.max()
    tips = _deformed(fields)[fields.contact_nodes[active]]
    middle = (tips.min(axis=0) + tips.max(axis=0)) / 2
    reach = max(0.75 * float(np.ptp(tips, axis=0).max()), 0.06 * _span(fields))
    half = np.array([reach, _FLAT * reach])
    low, high = middle - half, middle + half
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.spines[["top", "right"]].set_visible(True)
    unit = 0.8 * half[1] / size.max()
    arrows = axes.quiver(
        *tips.T, *(unit * fields.contact_forces[active]).T, angles="xy", pivot="tip",
        scale_units="xy", scale=1, width=0.0032 if len(tips) < 25 else 0.002,
        color=_ARROW, zorder=5,
    )  # fmt: skip
    arrows.set_path_effects(_CASING)
    factor, prefix = _prefixed(float(size.max()))
    axes.set_title(
        "(b) contact forces on the slave nodes; the largest is "
        f"{size.max() / factor:.3g} {prefix}N/m",
        loc="left",
    )
    corner = np.array([overview.get_xlim(), overview.get_ylim()]).T
    low, high = np.maximum(low, corner[0]), np.minimum(high, corner[1])
    frame = Rectangle((low[0], low[1]), *(high - low), fill=False, ec=_ARROW, lw=0.8)
    frame.set(zorder=4, path_effects=_CASING)
    overview.add_patch(frame)
    overview.annotate(
        "(b)", (high[0], high[1]), xytext=(3, 0), textcoords="offset points",
        color=_ARROW, path_effects=_CASING, va="top",
    )  # fmt: skip


def _span(fields: Fields) -> float:
    low, high = _box(fields)
    return float((high - low).max())


def _bar(
    figure: Figure, panels: list[Axes], fields: Fields, colours: Normalize
) -> None:
    limits = clipped_at(fields)
    assert limits is not None
    bar = figure.colorbar(
        ScalarMappable(norm=colours, cmap=_MAP),
        ax=panels,
        extend="max" if limits[1] > limits[0] else "neither",
        aspect=32,
        pad=0.015,
        fraction=0.04,
    )
    factor, prefix = _prefixed(limits[0])
    bar.ax.yaxis.set_major_formatter(lambda value, _: f"{value / factor:.4g}")
    bar.set_label(f"von Mises stress in {prefix}Pa")
    bar.outline.set_linewidth(0.5)
