"""The contact seen closely: pressures along the arc, active nodes, both methods."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from harness import Fields
from harness.files.experiment import Row
from reports.figures.deformed import edges, outlines
from reports.figures.style import COLOURS, INK, STYLE, log_log, look
from reports.paper.geometry import FILLS

ACTIVE = 1e-6  #: a node is in contact if its force exceeds this times the largest
CONTACTS = {  #: of the tables → as the figures call them
    "nts": "node-to-segment, the paper's",
    "mortar": "mortar, dual basis",
    "mortar-standard": "mortar, standard basis",
}
EXACT = 1e-12  #: relative errors below are rounding, and drawn there
_SOFT = "#8a93a0"


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
    span = _span(rows)
    with rc_context(STYLE):
        figure = Figure(figsize=(6.9, 5.6))
        grid = figure.add_gridspec(2, 2, height_ratios=(1, 0.85))
        steps, last = (figure.add_subplot(grid[0, i]) for i in (0, 1))
        _through_the_steps(figure, steps, rows, span)
        _at_the_end(last, rows, span)
        below = figure.add_subplot(grid[1, :])
        _active_set(below, rows, span)
        for axes in (steps, last, below):
            axes.set(xlim=span, xlabel="arc angle in degrees")
            axes.grid(visible=True, color=_SOFT, alpha=0.3, linewidth=0.4)
            axes.set_axisbelow(True)
    return figure


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


def _profile(rows: Sequence[Row], contact: str, step: int) -> tuple[Any, Any]:
    """Angles, ascending, and pressures in GPa."""
    points = sorted(
        (float(r["angle"]), float(r["pressure"]) / 1e9)
        for r in rows
        if r["contact"] == contact and r["step"] == step
    )
    angles, pressures = np.array(points).T
    return angles, pressures


def _through_the_steps(
    figure: Figure, axes: Axes, rows: Sequence[Row], span: tuple[float, float]
) -> None:
    last = max(int(r["step"]) for r in rows)
    # neither end of the map: one is lost on a dark page, the other on a white one
    colours = ListedColormap(colormaps["viridis"](np.linspace(0.25, 0.9, last)))
    norm = BoundaryNorm(np.arange(0.5, last + 1), last)
    for step in range(1, last + 1):
        x, p = _profile(rows, "nts", step)
        near = (x >= span[0]) & (x <= span[1])
        axes.plot(x[near], p[near], color=colours(norm(step)), linewidth=1)
    axes.set(ylim=(0, None), ylabel="contact pressure in GPa")
    axes.set_title("(a) node-to-segment, all load steps", loc="left")
    bar = figure.colorbar(
        ScalarMappable(norm=norm, cmap=colours), ax=axes, aspect=28, pad=0.02
    )
    bar.set_label("load step")
    bar.set_ticks(list(range(1, last + 1, max(last // 5, 1))))
    bar.ax.tick_params(which="minor", size=0)
    bar.outline.set_linewidth(0.5)


def _at_the_end(axes: Axes, rows: Sequence[Row], span: tuple[float, float]) -> None:
    last = max(int(r["step"]) for r in rows)
    for i, contact in enumerate(("nts", "mortar")):
        x, p = _profile(rows, contact, last)
        near = (x >= span[0]) & (x <= span[1])
        filled = COLOURS[0] if contact == "nts" else "none"
        style = {**look(i), "markersize": 4 - i, "markerfacecolor": filled}
        axes.plot(x[near], p[near], label=CONTACTS[contact], **style)
    axes.set(ylim=(0, 1.3 * axes.get_ylim()[1]), ylabel="contact pressure in GPa")
    axes.set_title(f"(b) both methods, load step {last}", loc="left")
    axes.legend(loc="upper left", fontsize=8.5)


def _active_set(axes: Axes, rows: Sequence[Row], span: tuple[float, float]) -> None:
    for i, contact in enumerate(("nts", "mortar")):
        found = [
            (float(r["angle"]), step)
            for step, loaded in active(rows, contact).items()
            for r in loaded
        ]
        style = {**look(i, line=False), "markersize": (3.4, 6.2)[i]}
        style |= {"markerfacecolor": (COLOURS[0], "none")[i], "markeredgewidth": 0.7}
        axes.plot(*zip(*found, strict=True), label=CONTACTS[contact], **style)
    last = max(int(r["step"]) for r in rows)
    axes.set(ylabel="load step", ylim=(0.3, last + 0.7))
    axes.yaxis.set_major_locator(MaxNLocator(min(last, 10), integer=True))
    axes.set_title("(c) active set: the nodes in contact", loc="left")
    axes.figure.legend(
        *axes.get_legend_handles_labels(), loc="outside lower center", ncols=2
    )


def zoom_figure(fields: Fields) -> Figure:
    """Draw the bodies where they touch: mesh, pressures along their normals."""
    assert fields.contact_nodes is not None
    assert fields.contact_forces is not None
    moved = fields.points + fields.displacement
    arc = moved[fields.contact_nodes]
    size = np.hypot(*fields.contact_forces.T)
    loaded = size > ACTIVE * size.max()
    with rc_context(STYLE):
        figure = Figure(figsize=(6.9, 4.1))
        axes = figure.subplots()
        _bodies(axes, fields, moved)
        normal = -fields.contact_forces[loaded] / size[loaded, None]
        pressure = size[loaded] / _lengths(fields)[loaded]
        reach = float(np.ptp(arc[loaded], axis=0).max())
        scale = 0.3 * reach / pressure.max()
        tips = arc[loaded] + scale * pressure[:, None] * normal
        _pressures(axes, arc[loaded], tips)
        low = np.minimum(arc[loaded].min(axis=0), tips.min(axis=0)) - 0.18 * reach
        high = np.maximum(arc[loaded].max(axis=0), tips.max(axis=0)) + 0.1 * reach
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.set(xlabel="$x$ in m", ylabel="$y$ in m")
        axes.spines[["top", "right"]].set_visible(True)
        _scale_bar(axes, scale, pressure.max(), low, reach)
    return figure


def _lengths(fields: Fields) -> Any:
    """Return the length of undeformed arc that belongs to each slave node, m."""
    assert fields.contact_nodes is not None
    chain = fields.points[fields.contact_nodes]
    half = np.linalg.norm(np.diff(chain, axis=0), axis=1) / 2
    return np.append(half, 0) + np.append(0, half)


def _bodies(axes: Axes, fields: Fields, moved: Any) -> None:
    for body in np.unique(fields.bodies):
        cells = fields.cells[fields.bodies == body]
        fill = FILLS[int(body) % len(FILLS)]
        axes.add_collection(
            PolyCollection(list(moved[cells]), facecolor=fill, edgecolor="none")
        )
        lines = LineCollection(list(moved[edges(cells)]), color=_SOFT, linewidth=0.35)
        axes.add_collection(lines)
    for loop in outlines(fields.cells):
        axes.plot(*moved[loop].T, color=INK, linewidth=0.9)


def _pressures(axes: Axes, feet: Any, tips: Any) -> None:
    """Draw each pressure along the normal of its node, and their envelope."""
    colour = COLOURS[1]
    outline = np.vstack([feet, tips[::-1]])
    axes.fill(*outline.T, color=colour, alpha=0.18, linewidth=0, zorder=4)
    axes.plot(*tips.T, color=colour, linewidth=1.2, zorder=5)
    axes.quiver(
        *feet.T, *(tips - feet).T, angles="xy", scale_units="xy", scale=1,
        color=colour, width=0.0022, zorder=5,
    )  # fmt: skip
    axes.plot(*feet.T, "o", color=INK, markersize=2.4, zorder=6)


def _scale_bar(
    axes: Axes, scale: float, largest: float, low: Any, reach: float
) -> None:
    """State the scale of the pressures by a bar of a round size."""
    unit = float(f"{largest / 2:.0e}")
    start = low + 0.05 * reach
    axes.annotate(
        "", (start[0], start[1] + scale * unit), tuple(start),
        arrowprops={"arrowstyle": "-|>", "color": COLOURS[1], "shrinkA": 0,
                    "shrinkB": 0, "lw": 1.2},
        zorder=7,
    )  # fmt: skip
    axes.annotate(
        f"pressure {unit / 1e9:g} GPa", (start[0], start[1] + scale * unit / 2),
        xytext=(6, 0), textcoords="offset points", va="center", zorder=7,
    )  # fmt: skip


def verification_figure(rows: Sequence[Row]) -> Figure:
    """Draw the errors against exact solutions over the mesh."""
    titles = {
        "patch": ("patch test", "elements along the block", "largest stress error"),
        "hertz": ("Hertz contact", "elements per half width", "$L^2$ pressure error"),
    }
    with rc_context(STYLE):
        figure = Figure(figsize=(6.9, 3.2))
        panels = figure.subplots(1, 2)
        for letter, axes, problem in zip("ab", panels, titles, strict=True):
            title, size, error = titles[problem]
            for i, contact in enumerate(CONTACTS):
                points = sorted(
                    (int(r["n"]), max(float(r["error"]), EXACT)) for r in rows
                    if r["problem"] == problem and r["contact"] == contact
                )  # fmt: skip
                style = {**look(i), "markersize": (4.5, 4.5, 7)[i]}
                style["markerfacecolor"] = "none" if i == 2 else style["color"]
                axes.plot(*zip(*points, strict=True), label=CONTACTS[contact], **style)
            log_log(axes, size, f"{error}, relative")
            axes.set_title(f"({letter}) {title}", loc="left")
        panels[0].set_ylim(EXACT / 10, 10)
        figure.legend(
            *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3
        )
    return figure
