"""Style of all figures: colours, markers, logarithmic axes, legible labels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import lcm, nan
from typing import Any

from mortarbench.harness import Record
from mortarbench.reports.document.figure import (
    INK,
    Axis,
    Figure,
    Intervals,
    Key,
    Legend,
    Look,
    Row,
    Series,
    numbers,
)
from mortarbench.reports.document.formatting import clean

#: Colours of the solvers. The hues of the first eight differ by at least 28°, and the
#: hues of all colours differ by at least 6°. The first four colours are Okabe and
#: Ito's. Every further colour is the OKLCH colour farthest from all previous ones under
#: normal vision, deuteranopia and protanopia (Machado et al. 2009), with a contrast of
#: at least 2.4 on light and dark pages.
COLOURS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8b6bf7", "#b0a93b", "#e17ffe",
    "#c9212e", "#216e45", "#4851d5", "#b02e9a", "#b775fe", "#698e2f", "#31a3b0",
    "#f34e6c", "#ff72d1", "#ce5dd2", "#c32066", "#008a80", "#6a5ee7", "#77650e",
    "#36b485", "#2c8240", "#889d37", "#859ff6", "#ee6f61", "#288de5", "#f47599",
    "#2063bf", "#067094",
)  # fmt: skip
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">")
DASHED, DOTTED = (3.7, 1.6), (1.0, 1.65)
DASHES = ((), DASHED, (6.4, 1.6, 1.0, 1.6), (4, 1, 1, 1, 1, 1), (1, 1))
GUIDE = Look(colour=INK, width=0.6)  #: reference lines
LEGEND_LINE = 0.21  #: height of a line of a legend, inches
TITLE = 0.24  #: height of the title of a figure, inches


def legible(label: str, limit: int = 32) -> str:
    """Replace characters missing in the font and escape mathematics in a user's name.

    matplotlib reads $…$ as a formula and hides labels that begin with an underscore.
    """
    printable = "".join(
        c if c.isascii() or "\u00a0" < c <= "\u00ff" or c == "…" else "?"
        for c in clean(label, limit)
    )
    escaped = printable.replace("$", r"\$")
    return f" {escaped}" if escaped.startswith("_") else escaped


def look(index: int) -> Look:
    """Return colour, marker and dashes of a solver, distinguishable in greyscale.

    Beyond the length of `COLOURS`, colours recur with other markers.
    """
    # complete cycles of (colour, marker)
    rounds = index // lcm(len(COLOURS), len(MARKERS))
    return Look(
        colour=COLOURS[index % len(COLOURS)],
        marker=MARKERS[(index + rounds) % len(MARKERS)],
        dash=DASHES[index % len(DASHES)],
    )


def log(label: str) -> Axis:
    """Return a logarithmic axis."""
    return Axis(label=label, log=True)


def solver_keys(names: Iterable[str], solvers: Sequence[str]) -> tuple[Key, ...]:
    """Return the legend keys of the solvers `names`.

    solvers : all solvers of the report, whose order determines colours and markers
    """
    return tuple(
        Key(label=legible(s), look=look(solvers.index(s)), solver=s) for s in names
    )


def below(keys: Sequence[Key], columns: int, title: str = "") -> Legend:
    """Return a legend below a figure or a row."""
    return Legend(keys=tuple(keys), columns=columns, title=title)


def run_ids(records: Iterable[Record]) -> tuple[str, ...]:
    """Return the identities of the measurements behind a point."""
    return tuple(r.identity for r in records)


def curve(
    points: Iterable[Sequence[Any]],
    style: Look,
    solver: str = "",
    bars: Mapping[str, float] | None = None,
    **how: Any,
) -> list[Series]:
    """Return points as one series; an empty list if no point is complete.

    points : (x, y), or (x, y, answer or its run_ids); estimates with an interval
        (`Interval`, `Ratio`) have error bars; points without x or y are omitted
    bars : cap, width and opacity of the error bars
    how : further attributes of `Series`
    """
    complete = [p for p in points if p[0] is not None and p[1] is not None]
    if not complete:
        return []
    x, y, *answers = zip(*complete, strict=True)
    for along, values in (("x", x), ("y", y)):
        if any(isinstance(v, tuple) for v in values):
            low, high = (
                numbers([getattr(v, end, nan) for v in values])
                for end in ("low", "high")
            )
            how["intervals"] = Intervals(low=low, high=high, along=along, **bars or {})  # type: ignore[arg-type]
    x, y = (numbers([getattr(v, "value", v) for v in values]) for values in (x, y))
    runs = tuple(a if isinstance(a, tuple) else a.run_ids for of in answers for a in of)
    return [Series(x=x, y=y, look=style, solver=solver, runs=runs, **how)]


def with_legend(
    rows: Sequence[Row],
    keys: Sequence[Key],
    columns: int,
    height: float,
    title: str = "",
) -> Figure:
    """Return a figure of rows of panels with a title above and a legend below.

    height : height of the rows, inches
    """
    return Figure(
        rows=tuple(rows),
        height=height + TITLE * bool(title) + LEGEND_LINE * -(-len(keys) // columns),
        legend=below(keys, columns),
        title=legible(title, 96),
    )
