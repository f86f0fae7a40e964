"""Figures 3 to 6, Table 1 and the times of Section 5, with published values."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mortarbench.reports.document import ABSENT, Table, clean, number, seconds
from mortarbench.reports.figures.style import (
    COLOURS,
    INK,
    MARKERS,
    curve,
    legend,
    logarithmic,
    panels,
    styled,
)
from mortarbench.reports.intervals import median_interval
from mortarbench.reports.paper import published

DOFS = "degrees of freedom $n$"
METHODS = {  #: name in tables → label in the report
    "triplets": "triplets, vectorised (the paper's method)",
    "compiled": "compiled, pattern included",
    "compiled-reused": "compiled, pattern reused",
    "geometric": "Cholesky, fixing nodes by geometry",
    "spectral": "Cholesky, fixing nodes by spectra (the paper's method)",
    "pinv": "dense pinv",
    "per-row": "one solve per row (the paper's method)",
    "condensed": "condensed",
}
LINES = {  #: row of the table of times → parts of an analysis
    "mesh and assembly": ("assembly",),
    "Cholesky": ("factor",),
    "contact rows (the paper: mortar), all steps": ("contact",),
    "dualisation, all steps": ("dualisation",),
    "Cholesky and dualisation together": ("factor", "dualisation"),
    "dual QPs, all steps": ("qp",),
    "recovery of u, all steps": ("recovery",),
}
PARTS = tuple(dict.fromkeys(part for parts in LINES.values() for part in parts))
#: parts of Figure 6 (c): label → method and parts
DUAL = {
    "dualisation, one solve per row": ("per-row", ("dualisation",)),
    "dualisation, condensed, with factor": ("condensed", ("factor", "dualisation")),
    "dual QPs, textbook SMALBE": ("per-row", ("qp",)),
    "dual QPs, our SMALBE": ("condensed", ("qp",)),
}
_PUBLISHED: dict[str, Any] = {
    "color": INK, "linestyle": "none", "marker": "*", "markersize": 10,
    "markerfacecolor": "white", "markeredgewidth": 0.9,
}  # fmt: skip


def medians(rows: pd.DataFrame, keys: Sequence[str]) -> pd.DataFrame:
    """Return the medians of seconds for each value of `keys`, with their intervals.

    Rows of one repeat are summed within each group.
    """
    sums = rows.groupby([*keys, "repeat"]).seconds.sum()
    return pd.DataFrame(
        [(*key, *median_interval(s), len(s)) for key, s in sums.groupby([*keys])],
        columns=[*keys, "median", "low", "high", "samples"],
    )


def nth(k: int, label: str = "") -> dict[str, Any]:
    """Return the style of the k-th curve of a figure without solvers."""
    return {"color": COLOURS[k], "marker": MARKERS[k], "label": label}


def titled(axes: Iterable[Axes], *titles: str) -> None:
    """Add letters and titles to panels."""
    for letter, one, title in zip("abcdef", axes, titles, strict=False):
        one.set_title(f"({letter}) {title}")


def _times(axes: Axes, rows: pd.DataFrame, x: str, **style: Any) -> None:
    t = medians(rows, [x])
    curve(axes, t[x], t["median"], (t.low, t.high), **style)


def assembly_figure(rows: pd.DataFrame) -> Figure:
    """Draw Figure 3 on linear and logarithmic axes."""
    with styled():
        figure, axes = panels(2)
        for one in axes:
            for k, method in enumerate(("triplets", "compiled", "compiled-reused")):
                _times(one, rows[rows.method == method], "n", **nth(k, METHODS[method]))
            label = f"published, both bodies ({published.MACHINE})"
            place = published.DOFS, published.SECONDS["assembly"]
            one.plot(*place, **_PUBLISHED, label=label)
            one.set(xlabel=DOFS, ylabel="assembly time in s")
        axes[0].set(xlim=0, ylim=0)
        axes[0].locator_params("x", nbins=4)
        logarithmic(axes[1])
        titled(axes, "linear scale", "logarithmic scale")
        legend(figure, axes, 2)
    return figure


def contact_figure(rows: pd.DataFrame) -> Figure:
    """Draw Figure 4: node-to-segment and mortar, a curve for each number of masters."""
    masters = sorted(set(rows.master))
    place = published.SEGMENTS["slave"], published.SECONDS["contact"] / published.STEPS
    with styled():
        figure, axes = panels(2, sharey=True)
        for one, method in zip(axes, ("nts", "mortar"), strict=True):
            for k, master in enumerate(masters):
                mine = rows[(rows.method == method) & (rows.master == master)]
                _times(one, mine, "slave", **nth(k, f"{master}"))
            one.set_xlabel("slave segments")
        label = f"{published.SEGMENTS['master']}, published"
        axes[0].plot(*place, **_PUBLISHED, label=label)
        axes[0].set(ylabel="time of one linearisation in s")
        for one in axes:
            logarithmic(one)
        axes[0].set_ylim(top=0.7)
        titled(axes, "node-to-segment, as in the paper", "mortar, dual basis")
        legend(figure, axes, len(masters) + 1)
        figure.legends[0].set_title("master segments")
    return figure


def inverse_figure(rows: pd.DataFrame) -> Figure:
    """Draw Figure 5: building K⁺ and multiplying with it.

    Times of the dense pseudoinverse are extrapolated by c·n³ and c·n². The factor c is
    fitted by least squares on logarithms to the upper half of the sizes; the band is
    the range of c over these sizes.
    """
    with styled():
        figure, axes = panels(2)
        for one, part, power in zip(axes, ("build", "multiply"), (3, 2), strict=True):
            for method, k in (("pinv", 2), ("geometric", 0), ("spectral", 1)):
                mine = rows[(rows.method == method) & (rows.part == part)]
                _times(one, mine, "n", **nth(k, METHODS[method]))
            dense = medians(rows[(rows.method == "pinv") & (rows.part == part)], ["n"])
            upper = dense[len(dense) // 2 :]
            c = upper["median"] / upper.n**power
            x = np.geomspace(dense.n.max(), rows.n.max(), 40)
            style: dict[str, Any] = {"color": COLOURS[2]}
            band = (c.min() * x**power, c.max() * x**power)
            one.fill_between(x, *band, **style, alpha=0.2, lw=0)
            label = "dense pinv, extrapolated: $c\\,n^3$ (a), $c\\,n^2$ (b)"
            middle = np.exp(np.log(c).mean()) * x**power
            one.plot(x, middle, ":", **style, label=label)
            one.set(xlabel=DOFS, ylabel="time in s")
            logarithmic(one)
        titled(axes, "building", "multiplication with a random vector")
        legend(figure, axes, 2)
    return figure


def scaling_figure(rows: pd.DataFrame) -> Figure:
    """Draw Figure 6: sizes, constraints, dualisation and QPs, complete analysis."""
    rows = rows.assign(m=rows.m_E + rows.m_I)
    sizes = rows.drop_duplicates("Nr").sort_values("Nr")
    with styled():
        figure, axes = panels(4, height=3.1)
        unknowns, constraints, dual, whole = axes
        unknowns.plot(sizes.Nr, sizes.n, **nth(0, "primal, $n$"))
        unknowns.plot(sizes.Nr, sizes.m, **nth(1, "dual, $m = m_E + m_I$"))
        constraints.plot(sizes.Nr, sizes.m_E, **nth(0, "Dirichlet equalities $m_E$"))
        constraints.plot(sizes.Nr, sizes.m_I, **nth(1, "contact inequalities $m_I$"))
        for k, (label, (method, parts)) in enumerate(DUAL.items()):
            mine = rows[(rows.method == method) & rows.part.isin(parts)]
            _times(dual, mine, "m", **nth(k, label))
        for words, part, look in (
            ("published: dualisation", "dualisation", {}),
            ("published: QPs", "qp", {"marker": "P", "markersize": 7}),
        ):
            place = published.ROWS, published.SECONDS[part]
            dual.plot(*place, **_PUBLISHED | look, label=words)
        for k, method in enumerate(("per-row", "condensed")):
            _times(whole, rows[rows.method == method], "n", **nth(k, METHODS[method]))
        whole.plot(published.DOFS, published.TOTAL, **_PUBLISHED, label="published")
        unknowns.set(xlabel="$N_r$", ylabel="unknowns", ylim=(100, 1e5))
        most = 1.35 * max(sizes.m_E.max(), sizes.m_I.max())
        constraints.set(xlabel="$N_r$", ylabel="rows", ylim=(0, most))
        dual.set(xlabel="size of the dual $m$", ylabel="time in s")
        whole.set(xlabel="size of the primal $n$", ylabel="time in s")
        logarithmic(unknowns, "y")
        for one, decades in ((dual, 4.5), (whole, 1.1)):  # room for the legend
            logarithmic(one)
            one.set_ylim(top=one.get_ylim()[1] * 10**decades)
        for one in axes:
            one.legend(loc="upper left", fontsize=8)
        titled(
            axes, "size of the problems", "constraints",
            "dualisation and QPs, all steps", "complete analysis",
        )  # fmt: skip
    return figure


def here(environment: dict[str, Any]) -> str:
    """Describe the machine on which the times were measured."""
    machine = environment.get("machine", {})
    cpu = machine.get("cpu") or "an unknown processor"
    return f"{cpu}, {machine.get('system', 'unknown system')}, one thread, Python"


def table_1(rows: pd.DataFrame) -> Table:
    """Return Table 1, compared with the counts of the paper."""
    heads = ["N", "nodes", "elements", "dofs", "segments"]
    summed = ["", *rows[heads[1:4]].sum(), ""]
    theirs = published.TABLE_1 | {"total": ("", *published.TOTALS, "")}
    lines = [*zip(rows.body, rows[heads].to_numpy().tolist(), strict=True)]
    return Table(
        name="table1",
        head=("", *heads, "the paper"),
        rows=tuple(
            (body, *map(str, ours), "equal" if same else "different size")
            for body, ours in (*lines, ("total", summed))
            for same in [tuple(ours) == theirs.get(body)]
        ),
        caption="Parameters of the largest problem (the paper's Table 1).",
    )


def timings(rows: pd.DataFrame, steps: int, machine: str) -> Table:
    """Tabulate the published times of Section 5, and the times measured here.

    rows : measurements of the complete analysis at one size
    """
    lines, (Nr, Nh) = [], rows.iloc[0][["Nr", "Nh"]]
    for name, parts in (LINES | {"total": PARTS}).items():
        theirs = sum(published.SECONDS.get(part, 0.0) for part in parts)
        of_parts = rows[rows.part.isin(parts)]
        way, ours = (
            medians(of_parts[of_parts.method == m], ["n"]).iloc[0]
            for m in ("per-row", "condensed")
        )
        shown = [
            f"{seconds(t['median'])}\n{seconds(t.low)} to {seconds(t.high)}"
            for t in (way, ours)
        ]
        ratio = ABSENT
        if theirs and (Nr, Nh) == (30, 15):  # as published
            value, low, high = theirs / ours[["median", "high", "low"]]
            ratio = f"{number(value)}\n[{number(low)}, {number(high)}]"
        lines.append((name, seconds(theirs or None), *shown, ratio))
    return Table(
        name="timings",
        head=("", "published", "the paper's method", "ours, condensed", "ratio"),
        rows=tuple(lines),
        caption=f"Section 5: times at Nr = {Nr}, Nh = {Nh}, {steps} steps. "
        f"Published: {published.MACHINE}; measured: {clean(machine)}. "
        "Condensed: the factorisation includes the condensation onto the interface and "
        "should be compared together with the dualisation. Ratio: published time over "
        "our condensed time, on different machines.",
    )
