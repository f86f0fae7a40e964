"""Figures of curves: times, scaling, profiles, iterations, accuracy, routes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from mortarbench.harness.solution import History
from mortarbench.reports.answer import Row
from mortarbench.reports.figures.style import (
    COLOURS,
    INK,
    MARKERS,
    curve,
    legend,
    legible,
    logarithmic,
    look,
    panels,
    styled,
)

MOST_PANELS = 4  #: largest number of panels of one figure
#: step types of SMALBE by letter, with their markers in histories
STEPS = {"c": (".", "CG"), "e": ("^", "expansion"), "p": ("s", "proportioning")}
AXES = {
    "n": "degrees of freedom $n$",
    "m": "size of the dual $m$",
    "total_seconds": "time in s",
    "mesh_seconds": "time from the mesh in s",
    "iterations": "iterations",
    "products": "products with $P$",
    "error": "relative error",
    "residual": "largest relative residual",
    "memory": "peak memory in MiB",
    "ratio": "time relative to a cold start",
}


def answer_figure(found: Sequence[Row], solvers: Sequence[str]) -> Figure:
    """Plot the ratios of the first screen with their intervals, a panel per row."""
    shown = [row for row in found if len(row.ranked) > 1][-MOST_PANELS:]
    most = max(len(row.ranked) for row in shown)
    with styled():
        figure, axes = panels(len(shown), height=0.55 + 0.21 * most)
        for one, row in zip(axes, shown, strict=True):
            names = [e.solver for e in row.ranked]
            for place, entry in enumerate(row.ranked):
                assert entry.time is not None
                style = look(solvers, entry.solver) | {"linestyle": "-"}
                ratio = entry.time.ratio
                one.plot([ratio.value], [-place], **style)
                if ratio.is_known:
                    one.plot(
                        [ratio.low, ratio.high], [-place, -place],
                        color=style["color"], gid=style["gid"],
                    )  # fmt: skip
            one.set_yticks([-float(i) for i in range(len(names))], map(legible, names))
            one.set_ylim(0.5 - most, 0.5)
            one.axvline(1, color=INK, lw=0.6)
            one.set_title(legible(f"{row.form or 'QP'}, {row.label}", 64))
            one.grid(visible=False, axis="y")
            values = [e.time.ratio.value for e in row.ranked if e.time]
            one.set_xlim(min(values) / 4, max(values) * 4)  # intervals may be endless
            logarithmic(one, "x")
        for one in axes[-2:]:
            one.set_xlabel("time relative to the fastest")
    return figure


def against(
    answers: pd.DataFrame,
    solvers: Sequence[str],
    x: str = "m",
    y: str = "total_seconds",
    *,
    by: str = "form",
) -> Figure | None:
    """Plot a column of verified answers against another, a panel for each form.

    A line connects the medians over the cases of one family with equal x. The result
    is None if no solver has two values of x.

    answers : verified answers at one tolerance
    """
    known = answers[(answers[x] > 0) & (answers[y] > 0)]
    groups = [
        (name, of)
        for name, of in known.groupby(by, sort=False)
        if of.groupby("solver")[x].nunique().max() > 1
    ][:MOST_PANELS]
    if not groups:
        return None
    with styled():
        figure, axes = panels(len(groups), sharey=True)
        for one, (name, of) in zip(axes, groups, strict=True):
            for solver in (s for s in solvers if s in set(of.solver)):
                for _, mine in of[of.solver == solver].groupby("family"):
                    middle = mine.groupby(x)[y].median()
                    curve(one, middle.index, middle.to_numpy(), **look(solvers, solver))
            one.set_title(legible(str(name) or "QP", 64))
            one.set_xlabel(AXES.get(x, x))
            logarithmic(one)
        axes[0].set_ylabel(AXES.get(y, y))
        legend(figure, axes)
    return figure


def profiles(answers: pd.DataFrame, solvers: Sequence[str]) -> Figure:
    """Plot performance profiles [1]_ of verified answers, a panel for each form.

    A curve at τ is the share of the cases that a solver solved within τ times the time
    of the fastest one. Cases that no solver solved count.

    References
    ----------
    .. [1] E. D. Dolan, J. J. Moré, Benchmarking optimization software with performance
       profiles, Mathematical Programming 91 (2002) 201-213

    """
    groups = list(answers.groupby("form", sort=False))[:MOST_PANELS]
    with styled():
        figure, axes = panels(len(groups), sharey=True)
        for one, (form, of) in zip(axes, groups, strict=True):
            cases = of.case.nunique()
            solved = of[of.verified].pivot_table(
                "total_seconds", "case", "solver", "first"
            )
            ratios = solved.div(solved.min(axis=1), axis=0)
            end = 1.3 * max(float(np.nanmax(ratios.to_numpy(), initial=1.0)), 2.0)
            for solver in (s for s in solvers if s in ratios):
                at = np.sort(ratios[solver].dropna())
                heights = np.arange(at.size + 1) / cases
                style = look(solvers, solver) | {"marker": ""}
                one.step(
                    [1, *at, end], [*heights[:1], *heights[1:], heights[-1]],
                    where="post", **style,
                )  # fmt: skip
            one.set(xlim=(1, end), ylim=(0, 1.03), title=legible(str(form) or "QP"))
            one.set_xlabel("τ, time relative to the fastest")
            logarithmic(one, "x")
        axes[0].set_ylabel("share of the cases")
        legend(figure, axes)
    return figure


def accuracy(answers: pd.DataFrame, solvers: Sequence[str]) -> Figure | None:
    """Plot the error against the time, a curve over the tolerances for each solver.

    The values are medians over the cases that a solver solved at every tolerance. With
    one tolerance, each solver is one point.
    """
    known = answers[
        answers.verified & (answers.error > 0) & (answers.total_seconds > 0)
    ]
    groups = list(known.groupby("form", sort=False))[:MOST_PANELS]
    if not groups:
        return None
    with styled():
        figure, axes = panels(len(groups), sharey=True)
        for one, (form, of) in zip(axes, groups, strict=True):
            tolerances = of.tol.nunique()
            for solver in (s for s in solvers if s in set(of.solver)):
                mine = of[of.solver == solver]
                whole = mine.groupby("case").tol.transform("nunique") == tolerances
                middle = (mine[whole] if whole.any() else mine).groupby("tol")
                middle = middle[["total_seconds", "error"]].median().sort_index()
                curve(one, middle.total_seconds, middle.error, **look(solvers, solver))
            one.set_title(legible(str(form) or "QP", 64))
            one.set_xlabel("median time in s")
            logarithmic(one)
        axes[0].set_ylabel("median relative error")
        legend(figure, axes)
    return figure


def routes(answers: pd.DataFrame, y: str = "mesh_seconds") -> Figure:
    """Plot time or memory from the mesh against n, a curve for each route.

    answers : the fastest answer of each route at each size, with the column `route`
    """
    known = answers[(answers.n > 0) & (answers[y] > 0)]
    groups = list(known.groupby("series", sort=False))[:MOST_PANELS]
    names = list(dict.fromkeys(known.route))
    with styled():
        figure, axes = panels(len(groups), sharey=True)
        for one, (name, of) in zip(axes, groups, strict=True):
            for k, route in enumerate(names):
                mine = of[of.route == route].sort_values("n")
                if len(mine):
                    curve(
                        one, mine.n, mine[y],
                        color=COLOURS[k % len(COLOURS)], label=legible(route),
                        marker=MARKERS[k % len(MARKERS)],
                    )  # fmt: skip
            one.set(title=legible(str(name), 60), xlabel=AXES["n"])
            logarithmic(one)
        axes[0].set_ylabel(AXES.get(y, y))
        legend(figure, axes, 3)
    return figure


def histories(
    found: Mapping[str, History], solvers: Sequence[str], title: str
) -> Figure:
    """Plot the convergence on one case against products, or iterations if unknown.

    Above: the norm of the projected gradient relative to its first value, with the
    types of steps of SMALBE. Below: the number of active bounds.

    found : histories by solver
    """
    with styled():
        figure, axes = panels(2, columns=1, height=2.1, sharex=True)
        counted = all("products" in of for of in found.values())
        for solver, of in found.items():
            size = len(next(iter(of.values())))
            x = np.asarray(of["products"] if counted else range(1, size + 1), float)
            style = look(solvers, solver) | {"marker": ""}
            norm = _gradient(of)
            if norm is not None:
                axes[0].plot(x, norm, **style)
                for letter, (marker, _) in STEPS.items():
                    at = np.asarray(of.get("step", ()), str) == letter
                    if at.any() and letter != "c":
                        axes[0].plot(
                            x[at], norm[at], marker, color=style["color"], ms=3,
                            gid=style["gid"],
                        )  # fmt: skip
            if "active" in of:
                axes[1].step(x, np.asarray(of["active"], float), where="post", **style)
        axes[0].set(ylabel="projected gradient", title=legible(title, 90))
        axes[1].set(ylabel="active bounds")
        axes[1].set_xlabel(AXES["products" if counted else "iterations"])
        logarithmic(axes[0], "y")
        legend(figure, axes)
    return figure


def _gradient(of: History) -> Any:
    """Return √(‖φ‖² + ‖β‖²) relative to its first positive value; None if unknown."""
    if not {"free_gradient", "chopped_gradient"} <= of.keys():
        return None
    norm = np.hypot(
        np.asarray(of["free_gradient"], float),
        np.asarray(of["chopped_gradient"], float),
    )
    positive = norm[np.isfinite(norm) & (norm > 0)]
    return np.where(norm > 0, norm, np.nan) / positive[0] if positive.size else None


def condition(answers: pd.DataFrame, x: str, quantities: Sequence[str]) -> Figure:
    """Plot condition numbers against n, or against the cells H/h of a subdomain.

    answers : answers with the columns `quantities`, by series
    """
    with styled():
        figure, axes = panels(len(quantities[:MOST_PANELS]))
        for one, name in zip(axes, quantities, strict=False):
            for k, (series, of) in enumerate(answers.groupby("series", sort=False)):
                middle = of.groupby(x)[name].median().dropna()
                curve(
                    one, middle.index, middle.to_numpy(),
                    color=COLOURS[k % len(COLOURS)], marker=MARKERS[k % len(MARKERS)],
                    label=legible(str(series), 60),
                )  # fmt: skip
            one.set(title=legible(name.replace("_", " ")))
            one.set_xlabel(AXES.get(x, f"{x}, cells along a subdomain"))
            logarithmic(one, "x")
        legend(figure, axes, 1)
    return figure
