"""Figures 3 to 6: times against sizes, with the intervals of their medians."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from harness.files.experiment import Row
from reports.figures.style import COLOURS, INK, STYLE, log_log, look
from reports.paper import published
from reports.paper.samples import Fit, Point, curve, fit

DOFS = "degrees of freedom $n$"
METHODS = {  #: of the tables → as the figures and tables of the report call them
    "triplets": "triplets, vectorised (the paper's way)",
    "compiled": "compiled, with its pattern",
    "compiled-reused": "compiled, pattern reused",
    "geometric": "Cholesky, fixing nodes by geometry",
    "spectral": "Cholesky, fixing nodes by spectra (the paper's way)",
    "pinv": "dense pinv",
    "per-row": "one solve per row (the paper's way)",
    "condensed": "condensed",
}
_PUBLISHED: dict[str, Any] = {
    "color": INK, "marker": "*", "markersize": 10, "linestyle": "none",
    "markerfacecolor": "white", "markeredgewidth": 0.9, "zorder": 5,
}  # fmt: skip


def _times(axes: Axes, points: Sequence[Point], label: str, style: Any) -> None:
    """Draw medians and their intervals."""
    x, t, low, high = np.array([(p.x, *p.time[:3]) for p in points]).T
    axes.plot(x, t, label=label, **style)
    bars = {"color": style["color"], "capsize": 2, "elinewidth": 0.7}
    axes.errorbar(x, t, yerr=[t - low, high - t], fmt="none", **bars)


def _titles(figure: Figure, titles: Sequence[str]) -> None:
    for letter, axes, title in zip("abcdef", figure.axes, titles, strict=False):
        axes.set_title(f"({letter}) {title}", loc="left")


def assembly_figure(rows: Sequence[Row]) -> Figure:
    """Draw Figure 3: linear and logarithmic."""
    with rc_context(STYLE):
        figure = Figure(figsize=(6.9, 3.4))
        left, right = figure.subplots(1, 2)
        for axes in (left, right):
            for i, method in enumerate(("triplets", "compiled", "compiled-reused")):
                points = curve(rows, "n", method=method)
                _times(axes, points, METHODS[method], look(i))
            axes.plot(
                published.DOFS, published.SECONDS["assembly"],
                label=f"published, both bodies ({published.MACHINE})", **_PUBLISHED,
            )  # fmt: skip
        left.set(
            xlabel=DOFS, ylabel="assembly time in s", xlim=(0, None), ylim=(0, None)
        )
        left.xaxis.set_major_locator(MaxNLocator(4))
        log_log(right, DOFS, "assembly time in s")
        _titles(figure, ("linear scale", "logarithmic scale"))
        _legend(figure, left)
    return figure


def contact_figure(rows: Sequence[Row]) -> Figure:
    """Draw Figure 4: node-to-segment and mortar, a line for each number of masters."""
    masters = sorted({row["master"] for row in rows})
    with rc_context(STYLE):
        figure = Figure(figsize=(6.9, 3.6))
        panels = figure.subplots(1, 2, sharey=True)
        for axes, method in zip(panels, ("nts", "mortar"), strict=True):
            for i, master in enumerate(masters):
                points = curve(rows, "slave", method=method, master=master)
                _times(axes, points, f"{master}", look(i))
        left = panels[0]
        at = published.SEGMENTS["slave"], published.SECONDS["contact"] / published.STEPS
        left.plot(*at, **_PUBLISHED)
        left.annotate(
            f"published\n({published.SEGMENTS['master']} master segments)", at,
            xytext=(9, 0), textcoords="offset points", va="center", fontsize=8.5,
        )  # fmt: skip
        log_log(left, "slave segments", "time of one linearisation in s")
        left.set_ylim(top=0.7)
        log_log(panels[1], "slave segments", "")
        _titles(figure, ("node-to-segment, as in the paper", "mortar, dual basis"))
        handles, labels = left.get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside lower center", ncols=len(masters),
            title="master segments",
        )  # fmt: skip
    return figure


def inverse_figure(rows: Sequence[Row]) -> Figure:
    """Draw Figure 5: building K⁺ and multiplying with it."""
    with rc_context(STYLE):
        figure = Figure(figsize=(6.9, 3.6))
        left, right = figure.subplots(1, 2)
        for axes, part in ((left, "build"), (right, "multiply")):
            for i, method in enumerate(("pinv", "geometric", "spectral")):
                points = curve(rows, "n", method=method, part=part)
                _times(axes, points, METHODS[method], look((2, 0, 1)[i]))
            _extrapolation(axes, pinv_fit(rows, part), max(r["n"] for r in rows))
            log_log(axes, DOFS, "time in s")
        _titles(figure, ("building", "multiplication with a random vector"))
        _legend(figure, left)
    return figure


def pinv_fit(rows: Sequence[Row], part: str) -> Fit:
    """Fit c·n³ to building the dense pseudoinverse, c·n² to multiplying with it."""
    points = curve(rows, "n", method="pinv", part=part)
    return fit(points, 3 if part == "build" else 2)


def _extrapolation(axes: Axes, law: Fit, until: Any) -> None:
    """Draw the fit where nothing was measured, with its band."""
    x = np.geomspace(law.until, float(until), 40)
    axes.fill_between(
        x, law.low * x**law.power, law.high * x**law.power, color=COLOURS[2], alpha=0.2,
        linewidth=0,
    )  # fmt: skip
    axes.plot(
        x, law.c * x**law.power, color=COLOURS[2], linestyle=(0, (1, 1.5)),
        label="dense pinv, not measured: fitted $c\\,n^3$ (a), $c\\,n^2$ (b)",
    )  # fmt: skip


def scaling_figure(rows: Sequence[Row]) -> Figure:
    """Draw Figure 6: sizes, constraints, dualisation and QPs, the whole."""
    with rc_context(STYLE):
        figure = Figure(figsize=(6.9, 6.3))
        (sizes, constraints), (dual, total) = figure.subplots(2, 2)
        _sizes(sizes, constraints, rows)
        _dual(dual, rows)
        _total(total, rows)
        _titles(
            figure,
            ("size of the problems", "constraints", "dualisation and QPs, all steps",
             "the whole analysis"),
        )  # fmt: skip
    return figure


def _sizes(sizes: Axes, constraints: Axes, rows: Sequence[Row]) -> None:
    points = sorted({(r["Nr"], r["n"], r["m_E"], r["m_I"]) for r in rows})
    Nr, n, m_E, m_I = np.array(points, dtype=float).T
    sizes.plot(Nr, n, label="primal, $n$", **look(0))
    sizes.plot(Nr, m_E + m_I, label="dual, $m = m_E + m_I$", **look(1))
    sizes.set(yscale="log", ylim=(100, 1e5), ylabel="unknowns")
    constraints.plot(Nr, m_E, label="Dirichlet equalities $m_E$", **look(0))
    constraints.plot(Nr, m_I, label="contact inequalities $m_I$", **look(1))
    constraints.set(ylim=(0, 1.35 * max(m_E.max(), m_I.max())), ylabel="rows")
    for axes in (sizes, constraints):
        axes.set_xlabel("$N_r$")
        axes.grid(visible=True, color="#8a93a0", alpha=0.3, linewidth=0.4)
        axes.legend(loc="upper left")


def _dual(axes: Axes, rows: Sequence[Row]) -> None:
    rows = [{**row, "m": int(row["m_E"]) + int(row["m_I"])} for row in rows]
    for i, (method, parts, label) in enumerate((
        ("per-row", ("dualisation",), "dualisation, one solve per row"),
        ("condensed", ("factor", "dualisation"), "the same, condensed, with factor"),
        ("per-row", ("qp",), "dual QPs, the textbook's SMALBE"),
        ("condensed", ("qp",), "dual QPs, our SMALBE"),
    )):  # fmt: skip
        _times(axes, curve(rows, "m", method=method, part=parts), label, look(i))
    stars = (("dualisation", "*", 9, "dualisation"), ("qp", "P", 7, "QPs"))
    for part, marker, size, name in stars:
        style = _PUBLISHED | {"marker": marker, "markersize": size}
        seconds = published.SECONDS[part]
        axes.plot(published.ROWS, seconds, label=f"published: {name}", **style)
    axes.set(yscale="log", xlabel="size of the dual $m$", ylabel="time in s")
    _head_room(axes, 3.8)
    axes.legend(loc="upper left", fontsize=8)


def _total(axes: Axes, rows: Sequence[Row]) -> None:
    for i, method in enumerate(("per-row", "condensed")):
        points = curve(rows, "n", method=method)
        _times(axes, points, METHODS[method], look(i))
    axes.plot(published.DOFS, published.TOTAL, label="published", **_PUBLISHED)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.set(yscale="log", xlabel="size of the primal $n$", ylabel="time in s")
    _head_room(axes, 2.2)
    axes.legend(loc="upper left", fontsize=8)


def _head_room(axes: Axes, decades: float) -> None:
    """Leave room for the legend above the curves, and a grid."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * 10 ** (0.35 * decades))
    axes.grid(visible=True, color="#8a93a0", alpha=0.3, linewidth=0.4)


def _legend(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
