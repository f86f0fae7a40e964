"""Figures 3 to 6, Table 1 and the times of Section 5, with published values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from mortarbench.harness import Vector
from mortarbench.harness.results.experiment import Experiment, Row
from mortarbench.reports.document.figure import (
    INK,
    Area,
    Axis,
    Figure,
    Key,
    Legend,
    Look,
    Mark,
    Panel,
    Series,
    Text,
    in_rows,
    limits,
    numbers,
)
from mortarbench.reports.document.formatting import bracketed, clean, seconds
from mortarbench.reports.document.layout import Cell, Table
from mortarbench.reports.figures.style import COLOURS, below, curve, log, look
from mortarbench.reports.paper import published
from mortarbench.reports.statistics.intervals import Interval, median_interval

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
PARTS = tuple({part: None for parts in LINES.values() for part in parts})
KEYS = {  #: CSV table → columns that identify a median
    "figure3": ("Nr", "n", "method"),
    "figure4": ("Nr", "Nh", "master", "slave", "method"),
    "figure5": ("Nr", "n", "method", "part"),
    "figure6": ("Nr", "Nh", "n", "m_E", "m_I", "method", "part"),
}
_PUBLISHED = Look(colour=INK, marker="*", size=10, edge=0.9, dash=None, fill="white")
_FITTED = Look(colour=COLOURS[2], dash=(1, 1.5))

Labelled = tuple[str, Sequence[Any], Look]  #: label, points and style of a curve


class Point(NamedTuple):
    """Point on a curve: size, and time in seconds with its interval."""

    x: float
    time: Interval


class Fit(NamedTuple):
    """Fit t = c·xᵖ with prescribed p, and the range of c over the fitted points."""

    power: int
    c: float
    low: float
    high: float
    since: float  #: smallest fitted size
    until: float  #: largest fitted size


def select(rows: Iterable[Row], **where: Any) -> list[Row]:
    """Return the rows with the values in `where`; a tuple lists alternatives."""
    return [
        row
        for row in rows
        if all(
            row[k] in (v if isinstance(v, tuple) else (v,)) for k, v in where.items()
        )
    ]


def medians(
    rows: Iterable[Row], keys: Sequence[str]
) -> dict[tuple[Any, ...], Interval]:
    """Return medians of the seconds of rows grouped by the values of `keys`.

    Rows of one repeat are summed within each group.
    """
    sums: dict[tuple[Any, ...], dict[Any, float]] = {}
    for row in rows:
        repeats = sums.setdefault(tuple(row[k] for k in keys), {})
        repeat = row["repeat"]
        repeats[repeat] = repeats.get(repeat, 0.0) + float(row["seconds"])
    return {key: median_interval(list(s.values())) for key, s in sums.items()}


def times(rows: Iterable[Row], x: str, **where: Any) -> list[Point]:
    """Return medians of selected rows against column `x`; sum the rows of a repeat."""
    by_size = medians(select(rows, **where), [x])
    return [Point(float(key), time) for (key,), time in sorted(by_size.items())]


def fit(points: Sequence[Point], power: int) -> Fit:
    """Fit c by least squares on logarithms to the upper half of the sizes."""
    upper = points[len(points) // 2 :]
    ratios = [p.time.value / p.x**power for p in upper]
    c = float(np.exp(np.mean(np.log(ratios))))
    return Fit(power, c, min(ratios), max(ratios), upper[0].x, upper[-1].x)


def pinv_fit(rows: Sequence[Row], part: str) -> Fit:
    """Fit the time to build the dense pseudoinverse (c·n³) or to apply it (c·n²)."""
    points = times(rows, "n", method="pinv", part=part)
    return fit(points, 3 if part == "build" else 2)


def titled(*panels: tuple[str, Panel]) -> tuple[Panel, ...]:
    """Add letters and titles to the panels of a figure."""
    return tuple(
        replace(panel, title=f"({letter}) {title}")
        for letter, (title, panel) in zip("abcdef", panels, strict=False)
    )


def labelled(curves: Iterable[Labelled]) -> tuple[tuple[Mark, ...], tuple[Key, ...]]:
    """Return curves and their legend keys."""
    marks, keys = list[Mark](), []
    for label, points, style in curves:
        marks += curve(points, style)
        keys.append(Key(label=label, look=style))
    return tuple(marks), tuple(keys)


def assembly_figure(rows: Sequence[Row]) -> Figure:
    """Draw Figure 3 on linear and logarithmic axes."""
    curves: list[Labelled] = [
        (METHODS[method], times(rows, "n", method=method), look(i))
        for i, method in enumerate(("triplets", "compiled", "compiled-reused"))
    ]
    words = f"published, both bodies ({published.MACHINE})"
    place = published.DOFS, published.SECONDS["assembly"]
    marks, keys = labelled([*curves, (words, [place], _PUBLISHED)])
    time = "assembly time in s"
    left = Panel(
        x=Axis(label=DOFS, low=0, most=4),
        y=Axis(label=time, low=0),
        marks=marks,
        grid="none",
    )
    right = Panel(x=log(DOFS), y=log(time), marks=marks)
    panels = titled(("linear scale", left), ("logarithmic scale", right))
    return Figure(rows=in_rows(panels, 2), height=3.4, legend=below(keys, 2))


def contact_figure(rows: Sequence[Row]) -> Figure:
    """Draw Figure 4: node-to-segment and mortar, a curve for each number of masters."""
    masters = sorted({row["master"] for row in rows})
    place = published.SEGMENTS["slave"], published.SECONDS["contact"] / published.STEPS
    name = f"published\n({published.SEGMENTS['master']} master segments)"
    panels = []
    for method, title in (
        ("nts", "node-to-segment, as in the paper"),
        ("mortar", "mortar, dual basis"),
    ):
        first = method == "nts"
        marks, keys = labelled(
            (f"{master}", times(rows, "slave", method=method, master=master), look(i))
            for i, master in enumerate(masters)
        )
        panel = Panel(
            x=log("slave segments"),
            y=Axis(
                label="time of one linearisation in s" * first,
                log=True,
                high=0.7,
                shared="time",
                numbered=first,
            ),
            marks=(*marks, *curve([place] * first, _PUBLISHED)),
            texts=(Text(text=name, place=place, offset=(9, 0)),) * first,
        )
        panels.append((title, panel))
    return Figure(
        rows=in_rows(titled(*panels), 2),
        height=3.6,
        legend=below(keys, len(masters), "master segments"),
    )


def inverse_figure(rows: Sequence[Row]) -> Figure:
    """Draw Figure 5: building K⁺ and multiplying with it."""
    until = float(max(r["n"] for r in rows))
    panels = []
    for part, title in (
        ("build", "building"),
        ("multiply", "multiplication with a random vector"),
    ):
        marks, keys = labelled(
            (METHODS[method], times(rows, "n", method=method, part=part), look(i))
            for method, i in (("pinv", 2), ("geometric", 0), ("spectral", 1))
        )
        law = pinv_fit(rows, part)  # extrapolated beyond the measured sizes
        x = np.geomspace(law.until, until, 40)
        at, low, middle, high = (
            numbers(v)
            for v in (x, *(c * x**law.power for c in (law.low, law.c, law.high)))
        )
        band = Area(x=at, low=low, high=high, colour=COLOURS[2], opacity=0.2)
        marks = (*marks, band, Series(x=at, y=middle, look=_FITTED))
        panels.append((title, Panel(x=log(DOFS), y=log("time in s"), marks=marks)))
    words = "dense pinv, extrapolated: $c\\,n^3$ (a), $c\\,n^2$ (b)"
    return Figure(
        rows=in_rows(titled(*panels), 2),
        height=3.6,
        legend=below((*keys, Key(label=words, look=_FITTED)), 2),
    )


def scaling_figure(rows: Sequence[Row]) -> Figure:
    """Draw Figure 6: sizes, constraints, dualisation and QPs, complete analysis."""
    sizes = sorted({(r["Nr"], r["n"], r["m_E"], r["m_I"]) for r in rows})
    Nr, n, m_E, m_I = np.array(sizes, dtype=float).T
    most = float(max(m_E.max(), m_I.max()))
    unknowns = _against_Nr(
        Nr,
        Axis(label="unknowns", log=True, low=100, high=1e5),
        {"primal, $n$": n, "dual, $m = m_E + m_I$": m_E + m_I},
    )
    constraints = _against_Nr(
        Nr,
        Axis(label="rows", low=0, high=1.35 * most),
        {"Dirichlet equalities $m_E$": m_E, "contact inequalities $m_I$": m_I},
    )
    summed = [{**row, "m": int(row["m_E"]) + int(row["m_I"])} for row in rows]
    dual, whole = list[Labelled](), list[Labelled]()
    for i, (label, method, parts) in enumerate(
        (
            ("dualisation, one solve per row", "per-row", ("dualisation",)),
            (
                "dualisation, condensed, with factor",
                "condensed",
                ("factor", "dualisation"),
            ),
            ("dual QPs, textbook SMALBE", "per-row", ("qp",)),
            ("dual QPs, our SMALBE", "condensed", ("qp",)),
        )
    ):
        points = times(summed, "m", method=method, part=parts)
        dual.append((label, points, look(i)))
    for label, part, marker, size in (
        ("published: dualisation", "dualisation", "*", 9.0),
        ("published: QPs", "qp", "P", 7.0),
    ):
        style = replace(_PUBLISHED, marker=marker, size=size)
        dual.append((label, [(published.ROWS, published.SECONDS[part])], style))
    for i, method in enumerate(("per-row", "condensed")):
        whole.append((METHODS[method], times(rows, "n", method=method), look(i)))
    whole.append(("published", [(published.DOFS, published.TOTAL)], _PUBLISHED))
    panels = titled(
        ("size of the problems", unknowns),
        ("constraints", constraints),
        (
            "dualisation and QPs, all steps",
            _with_head_room("size of the dual $m$", dual, 3.8),
        ),
        ("complete analysis", _with_head_room("size of the primal $n$", whole, 2.2)),
    )
    return Figure(rows=in_rows(panels, 2), height=6.3)


def _against_Nr(Nr: Vector, y: Axis, curves: Mapping[str, Vector]) -> Panel:
    marks, keys = labelled(
        (name, list(zip(Nr, values, strict=True)), look(i))
        for i, (name, values) in enumerate(curves.items())
    )
    legend = Legend(keys=keys, place="upper left")
    return Panel(x=Axis(label="$N_r$"), y=y, marks=marks, legend=legend)


def _with_head_room(size: str, curves: Sequence[Labelled], decades: float) -> Panel:
    """Return a panel of labelled curves with space above for the legend."""
    marks, keys = labelled(curves)
    panel = Panel(
        x=Axis(label=size, most=4),
        y=log("time in s"),
        marks=marks,
        legend=Legend(keys=keys, place="upper left", size=8),
    )
    low, high = limits([panel], "y")
    head = high * 10 ** (0.35 * decades)
    return replace(panel, y=replace(panel.y, low=low, high=head))


def here(machine: dict[str, Any]) -> str:
    """Describe the machine on which the times were measured."""
    cpu = machine.get("cpu") or "an unknown processor"
    return f"{cpu}, {machine.get('system', 'unknown system')}, one thread, Python"


def largest(experiment: Experiment) -> list[Row]:
    """Return the measurements of the analysis at the largest size."""
    rows = experiment.tables["figure6"]
    return select(rows, Nr=max(int(row["Nr"]) for row in rows))


def of_table_1(rows: Sequence[Row]) -> bool:
    """Return whether the rows have the size for which the paper states times."""
    return (rows[0]["Nr"], rows[0]["Nh"]) == (30, 15)


def table_1(experiment: Experiment) -> Table:
    """Return Table 1, compared with the counts of the paper."""
    heads = ("nodes", "elements", "dofs")
    counted = experiment.tables["table1"]
    lines: list[tuple[Cell, tuple[Any, ...], tuple[Any, ...]]] = [
        (
            Cell(text=str(r["body"])),
            tuple(int(r[k]) for k in ("N", *heads, "segments")),
            published.TABLE_1[str(r["body"])],
        )
        for r in counted
    ]
    sums = tuple(sum(int(r[k]) for r in counted) for k in heads)
    total = ("", *published.TOTALS, "")
    lines.append((Cell(text="total", kind="total"), ("", *sums, ""), total))
    return Table(
        caption="Parameters of the largest problem (the paper's Table 1).",
        columns=("", "N", *heads, "segments", "the paper"),
        rows=tuple(
            (
                name,
                *(Cell(text=str(v), value=v or None) for v in ours),
                Cell(text="equal" if ours == theirs else "different size"),
            )
            for name, ours, theirs in lines
        ),
    )


def timings(experiment: Experiment) -> Table:
    """Tabulate the published times of Section 5, and the times measured here."""
    rows = largest(experiment)
    steps = experiment.setting["plan"]["steps"]
    machine = here(experiment.setting["environment"].get("machine", {}))
    lines = []
    for name, parts in (LINES | {"total": PARTS}).items():
        published_time = sum(published.SECONDS.get(part, 0.0) for part in parts)
        way, ours = (
            times(rows, "n", method=m, part=parts)[0].time
            for m in ("per-row", "condensed")
        )
        ratio = Cell()
        if published_time and of_table_1(rows):
            ends = (ours.value, ours.high, ours.low)
            text = bracketed(*(published_time / t for t in ends))
            ratio = Cell(text=text, value=published_time / ours.value)
        lines.append(
            (
                Cell(text=name, kind="total" if parts == PARTS else ""),
                Cell(text=f"{published_time:.4g} s", value=published_time)
                if published_time
                else Cell(),
                Cell(text=seconds(way), value=way.value),
                Cell(text=seconds(ours), value=ours.value),
                ratio,
            )
        )
    return Table(
        caption=f"Section 5: times at Nr = {rows[0]['Nr']}, Nh = {rows[0]['Nh']}, "
        f"{steps} steps. Published: {published.MACHINE}; ours: {clean(machine)}. "
        "Condensed: the factorisation includes the condensation onto the interface and "
        "should be compared together with the dualisation. Ratio: published time over "
        "our condensed time, on different machines.",
        columns=(
            "",
            "published",
            "ours, the paper's method",
            "ours, condensed",
            "ratio",
        ),
        rows=tuple(lines),
    )


def csv_tables(experiment: Experiment) -> dict[str, pd.DataFrame]:
    """Return the tables of all figures (in seconds), Table 1 and the published times.

    The column `kind` distinguishes measured times from those fitted beyond the measured
    sizes.
    """
    frames = {"table1": pd.DataFrame(list(experiment.tables["table1"]))}
    for name, columns in KEYS.items():
        rows = [
            dict(zip(columns, key, strict=True))
            | {
                "kind": "measured",
                "median": t.value,
                "low": t.low,
                "high": t.high,
                "coverage": t.coverage,
                "samples": t.samples,
            }
            for key, t in medians(experiment.tables[name], columns).items()
        ]
        if name == "figure5":
            rows += _fitted(experiment.tables[name])
        frames[name] = pd.DataFrame(rows)
    frames["published"] = pd.DataFrame(
        {"part": part, "seconds": s, "machine": published.MACHINE}
        for part, s in (published.SECONDS | {"total": published.TOTAL}).items()
    )
    return frames


def _fitted(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Tabulate the fits at sizes without measurements of the dense pseudoinverse."""
    sizes = sorted({(int(r["Nr"]), int(r["n"])) for r in rows})
    return [
        {"Nr": Nr, "n": n, "method": "pinv", "part": part, "kind": "fitted"}
        | {name: c * float(n) ** law.power
           for name, c in (("median", law.c), ("low", law.low), ("high", law.high))}
        for part in ("build", "multiply")
        for law in [pinv_fit(rows, part)]
        for Nr, n in sizes
        if n > law.until
    ]  # fmt: skip
