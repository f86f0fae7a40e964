"""Figures beyond the paper: pressures, both contact methods, load steps."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure

from mortarbench.reports.document import Table, law, number
from mortarbench.reports.figures.style import (
    INK,
    WIDTH,
    Drawing,
    legend,
    logarithmic,
    panels,
    styled,
)
from mortarbench.reports.intervals import PowerLaw, power_law
from mortarbench.reports.paper.bodies import ACTIVE
from mortarbench.reports.paper.timings import nth, titled

CONTACTS = {  #: name in tables → label in figures
    "nts": "node-to-segment (the paper's method)",
    "mortar": "mortar, dual basis",
    "mortar-standard": "mortar, standard basis",
}
EXACT = 1e-12  #: smaller relative errors are due to rounding and drawn at this value
QUANTITIES = {  #: name in the figure → columns of its components
    "tip displacement": ["tip_x", "tip_y"],
    "contact force": ["force_x", "force_y"],
}
SINCE = 5  #: minimum number of steps in fits; coarser stepping is pre-asymptotic
PAPER = 10  #: number of load steps in the paper, with one linearisation each
#: size of the marks of both methods in the active set, where they coincide
_SIZES = {"nts": 3.4, "mortar": 6.2}


def active(rows: pd.DataFrame, contact: str) -> pd.DataFrame:
    """Return the rows of the nodes in contact, for one contact method."""
    mine = rows[rows.contact == contact]
    return mine[mine.force > ACTIVE * mine.force.max()]


def pressure_figure(rows: pd.DataFrame) -> Figure:
    """Plot pressure against arc angle, and the active set against load steps.

    Angles include all nodes that are ever in contact, and two more on either side.
    """
    touched = {contact: active(rows, contact) for contact in _SIZES}
    ever = pd.concat(touched.values()).angle
    margin = 2 * np.diff(np.unique(rows.angle)[:2])[0]
    low, high = ever.min() - margin, ever.max() + margin
    shown = rows[rows.angle.between(low, high)].sort_values("angle")
    last = int(rows.step.max())
    # viridis without its ends, which have low contrast on dark or white pages
    colours = colormaps["viridis"](np.linspace(0.25, 0.9, last))
    with styled():
        figure = Drawing(figsize=(WIDTH, 5.6))
        grid = figure.add_gridspec(2, 2, height_ratios=(1, 0.85))
        places = (grid[0, 0], grid[0, 1], grid[1, :])
        through, at_end, sets = axes = [figure.add_subplot(at) for at in places]
        steps = shown[shown.contact == "nts"].groupby("step")
        for colour, (_, mine) in zip(colours, steps, strict=True):
            through.plot(mine.angle, mine.pressure / 1e9, color=colour, lw=1)
        norm = BoundaryNorm(np.arange(last + 1) + 0.5, last)
        bar = ScalarMappable(norm, ListedColormap(list(map(tuple, colours))))
        figure.colorbar(bar, ax=through, label="load step", ticks=(1, last))
        for k, (contact, size) in enumerate(_SIZES.items()):
            mine = shown[(shown.contact == contact) & (shown.step == last)]
            hollow = {"markerfacecolor": "none"} if k else {}
            style = nth(k, CONTACTS[contact]) | hollow
            at_end.plot(mine.angle, mine.pressure / 1e9, **style, ms=4 - k)
            nodes = touched[contact]
            sets.plot(nodes.angle, nodes.step, **style, ms=size, mew=0.7, ls="none")
        for one in axes:
            one.set(xlabel="arc angle in degrees", xlim=(low, high))
        for one in (through, at_end):
            one.set(ylabel="contact pressure in GPa", ylim=(0, None))
        sets.set(ylabel="load step", ylim=(0.3, last + 0.7))
        sets.locator_params("y", nbins=min(last, 10), integer=True)
        titled(
            axes, "node-to-segment, all load steps", f"both methods, load step {last}",
            "active set: the nodes in contact",
        )  # fmt: skip
        legend(figure, [at_end])
    return figure


def verification_figure(rows: pd.DataFrame) -> Figure:
    """Plot errors relative to exact solutions against mesh size."""
    words = {
        "patch": ("elements along the block", "largest stress error"),
        "hertz": ("elements per half width", "$L^2$ pressure error"),
    }
    with styled():
        figure, axes = panels(2)
        for one, (problem, (size, error)) in zip(axes, words.items(), strict=True):
            for k, (contact, label) in enumerate(CONTACTS.items()):
                mine = rows[(rows.problem == problem) & (rows.contact == contact)]
                mine = mine.sort_values("n")
                hollow = {"markerfacecolor": "none", "ms": 7} if k == 2 else {}
                one.plot(mine.n, mine.error.clip(EXACT), **nth(k, label) | hollow)
            one.set(xlabel=size, ylabel=f"{error}, relative")
            logarithmic(one)
        axes[0].set_ylim(EXACT / 10, 10)
        titled(axes, "patch test", "Hertz contact")
        legend(figure, axes)
    return figure


def errors(rows: pd.DataFrame, relin: int, quantity: str) -> pd.Series:
    """Return relative errors by number of steps; the last row is the reference."""
    vectors = rows[QUANTITIES[quantity]].astype(float)
    reference = vectors.iloc[-1]
    error = np.linalg.norm(vectors - reference, axis=1) / np.linalg.norm(reference)
    series = pd.Series(error, index=rows.steps)[:-1]
    return series[(rows.relin[:-1] == relin).to_numpy()].sort_index()


def order(rows: pd.DataFrame, relin: int, quantity: str) -> PowerLaw | None:
    """Fit error ~ (1/steps)ᵖ from SINCE steps on; None for fewer than three points."""
    kept = errors(rows, relin, quantity)
    kept = kept[(kept.index >= SINCE) & (kept > 0)]
    return power_law([(1 / kept.index, kept)])


def stepping_figure(rows: pd.DataFrame) -> Figure:
    """Plot the errors of both quantities against the number of steps.

    A guide line of slope −1 is above the curves.
    """
    steps = np.array([rows.steps.min(), rows.steps.max()])
    with styled():
        figure, axes = panels(2)
        for one, quantity in zip(axes, QUANTITIES, strict=True):
            for k, relin in enumerate(np.unique(rows.relin[:-1])):
                error = errors(rows, relin, quantity)
                error = error[error > 0]
                one.plot(error.index, error, **nth(k, f"{relin}"))
            first = 3 * errors(rows, 1, quantity).iloc[0] * steps[0] / steps
            one.plot(steps, first, color=INK, lw=0.7, ls="--")
            one.annotate(
                "first order", (np.sqrt(steps.prod()), np.sqrt(first.prod())), (4, 3),
                textcoords="offset points",
            )  # fmt: skip
            one.set(xlabel="load steps", ylabel="relative error")
            logarithmic(one)
        titled(axes, *QUANTITIES)
        legend(figure, axes)
        figure.legends[0].set_title("linearisations per step")
    return figure


def orders(rows: pd.DataFrame) -> Table:
    """Tabulate fitted orders, and errors at the number of steps of the paper."""
    heads = [(f"{q}: order [95 %]", f"error at {PAPER} steps") for q in QUANTITIES]
    lines = []
    for relin in np.unique(rows.relin[:-1]):
        cells = [str(relin)]
        for q in QUANTITIES:
            error = errors(rows, relin, q).get(PAPER)
            cells += [law(order(rows, relin, q)), number(error, 2)]
        lines.append(tuple(cells))
    return Table(
        name="orders",
        head=("linearisations per step", *sum(heads, ())),
        rows=tuple(lines),
        caption=f"Order in 1/steps, fitted to {SINCE} and more steps, and relative "
        f"error at {PAPER} steps. The first row is the scheme of the paper.",
        texts=0,
    )
