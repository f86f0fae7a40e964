"""Conversion of figures with curves to plain data for the script of the page.

Formulas in labels are written in matplotlib's mathtext; the page shows them as plain
text.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from math import isfinite
from typing import Any

import numpy as np

from mortarbench.reports.document.figure import (
    INK,
    Area,
    Axis,
    Figure,
    Key,
    Legend,
    Look,
    Mark,
    Numbers,
    Panel,
    Runs,
    Segments,
    Series,
    fitted,
)

Data = dict[str, Any]

#: maximum number of points of a line without run_ids of its points; longer lines keep
#: only local extremes
MOST = 4000
_NAMED = {
    "lambda": "λ",
    "sigma": "σ",
    "tau": "τ",
    "rho": "ρ",
    "mu": "µ",
    "nu": "ν",
    "alpha": "α",
    "kappa": "κ",
    "Gamma": "Γ",
    "times": "×",
    "cdot": "·",
    "leq": "≤",
    "geq": "≥",
    "infty": "∞",
    "pm": "±",
    "approx": "≈",
    "%": "%",
}
_RAISED = str.maketrans("0123456789-+/nkpP.", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁺ᐟⁿᵏᵖᴾ·")
_LOWERED = str.maketrans("0123456789kij", "₀₁₂₃₄₅₆₇₈₉ₖᵢⱼ")


def panels(figure: Figure, solvers: Mapping[str, int]) -> list[Data]:
    """Return the panels of a figure.

    solvers : label → position in the order of the page
    """
    whole = fitted(figure)
    heights = [row.height for row in whole.rows]
    legends = [row.legend for row in whole.rows if row.legend]
    common = _legend([whole.legend, *legends] if whole.legend else legends, solvers)
    parts: list[Data] = []
    groups: dict[str, int] = {}
    for row in whole.rows:
        for panel in row.panels:
            own = panel.x.shared or f"\0{len(parts)}"  # unique name of an unshared axis
            parts.append(
                {
                    **_panel(panel, solvers),
                    "height": round(whole.height * row.height / sum(heights), 2),
                    "share": groups.setdefault(own, len(groups)),
                    "columns": whole.columns,
                }
            )
    parts[0]["common"] = common
    parts[0]["heading"] = plain(whole.title)
    return parts


def _panel(panel: Panel, solvers: Mapping[str, int]) -> Data:
    own = [panel.legend] if panel.legend else []
    if panel.bar is not None:
        looks = (Look(colour=name) for name in panel.bar.colours)
        keys = (Key(label=str(k), look=look) for k, look in enumerate(looks, 1))
        own.append(Legend(keys=tuple(keys), title=panel.bar.label))
    return {
        "title": plain(panel.title),
        "x": _axis(panel.x),
        "y": _axis(panel.y),
        "traces": [t for mark in panel.marks for t in _traces(mark, solvers)],
        "rules": [
            look_of(rule.look) | {"axis": rule.axis, "at": rule.at}
            for rule in panel.rules
        ],
        "texts": [
            {
                "text": plain(text.text),
                "place": list(text.place),
                "inside": list(text.inside),
                "align": list(text.align),
            }
            for text in panel.texts
        ],
        "own": _legend(own, solvers),
    }


def _axis(axis: Axis) -> Data:
    named = axis.ticks is not None
    return {
        "label": plain(axis.label),
        "log": axis.log,
        "limits": rounded((axis.low or 0.0, axis.high or 0.0), 9),
        "ticks": [[v, plain(name)] for v, name in axis.ticks or ()] if named else None,
        "numbered": axis.numbered,
    }


def _traces(mark: Mark, solvers: Mapping[str, int]) -> Iterator[Data]:
    whose = {"s": solvers.get(mark.solver, -1)}
    match mark:
        case Series():
            yield whose | _line(mark)
            yield from (whose | part for part in _intervals(mark))
        case Area():
            yield whose | {
                "kind": "area",
                "colour": colour(mark.colour),
                "opacity": mark.opacity,
                "outlines": [rounded(_outline(mark))],
            }
        case Segments():
            yield whose | _segments(mark.ends, mark.colour, mark.width, mark.runs)


def _line(series: Series) -> Data:
    traced = len(series.runs) == len(series.x)
    kept = range(len(series.x)) if traced else _thinned(series.y)
    return {
        **look_of(series.look),
        "kind": "line",
        "step": series.step,
        "few": series.few,
        "x": rounded(series.x[i] for i in kept),
        "y": rounded(series.y[i] for i in kept),
        "runs": series.runs,
    }


def _thinned(y: Numbers) -> list[int]:
    """Return indices of the ends of a line and of the extremes of its stretches."""
    count = len(y)
    if count <= MOST:
        return list(range(count))
    size = -(-2 * count // MOST)
    kept = {0, count - 1}
    values = np.nan_to_num(y, nan=-np.inf)
    for start in range(0, count, size):
        stretch = values[start : start + size]
        kept |= {start + int(stretch.argmin()), start + int(stretch.argmax())}
    return sorted(kept)


def _intervals(series: Series) -> Iterator[Data]:
    """Yield error bars as segments, and the strokes at their ends as marks."""
    bars = series.intervals
    if bars is None:
        return
    x, y, vertical = series.x, series.y, bars.along == "y"
    low, high = ((x, end) if vertical else (end, y) for end in (bars.low, bars.high))
    ends = zip(*low, *high, strict=True)
    yield _segments(tuple(ends), series.look.colour, bars.width, series.runs)
    cap = Look(
        colour=series.look.colour,
        marker="_" if vertical else "|",
        dash=None,
        size=2 * bars.cap,
        opacity=bars.opacity,
    )
    for at in (low, high):
        yield _line(Series(x=at[0], y=at[1], look=cap, runs=series.runs))


def _segments(ends: Sequence[Numbers], name: str, width: float, runs: Runs) -> Data:
    return {
        "kind": "segments",
        "colour": colour(name),
        "width": width,
        "ends": [rounded(one) for one in ends],
        "runs": runs,
    }


def _outline(area: Area) -> Iterator[float]:
    """Yield the outline of an area: along its upper curve, and back along the lower."""
    for values, direction in ((area.high, 1), (area.low, -1)):
        points = list(zip(area.x, values, strict=True))
        if area.step:  # each value applies until the next point
            stairs = [((x, y0), (x, y)) for (_, y0), (x, y) in pairwise(points)]
            points[1:] = [point for step in stairs for point in step]
        for point in points[::direction]:
            yield from point


def _legend(legends: Sequence[Legend], solvers: Mapping[str, int]) -> Data:
    titles = dict.fromkeys(plain(one.title) for one in legends)
    return {
        "title": ", ".join(filter(None, titles)),
        "keys": [
            look_of(key.look)
            | {"label": plain(key.label), "s": solvers.get(key.solver, -1)}
            for one in legends
            for key in one.keys
        ],
    }


def look_of(look: Look) -> Data:
    """Return the style of a line and its marks; the page scales lengths to pixels."""
    dash = look.dash
    return {
        "colour": colour(look.colour),
        "marker": look.marker,
        "hollow": look.fill in ("none", "white"),
        "dash": None
        if dash is None
        else " ".join(f"{v * look.width:.3g}" for v in dash),
        "width": look.width,
        "size": look.size,
        "opacity": look.opacity,
    }


def colour(name: str) -> str:
    """Return a colour for SVG; ink becomes the colour of the surrounding text."""
    return "currentColor" if name == INK else name


def rounded(values: Any, digits: int = 6) -> list[float | None]:
    """Round to significant digits; None for values that are not finite."""
    return [float(f"{v:.{digits}g}") if isfinite(v) else None for v in values]


def plain(text: str) -> str:
    r"""Convert mathtext to plain text: "size $n$" becomes "size n".

    An escaped dollar, as written by `reports.figures.style.legible`, becomes a dollar.
    """
    parts = re.split(r"(?<!\\)\$", text)
    shown = [_formula(p) if i % 2 else p for i, p in enumerate(parts)]
    return "".join(shown).replace(r"\$", "$").strip()


def _formula(tex: str) -> str:
    tex = tex.replace(r"\|", "‖").replace(r"\,", " ")
    tex = re.sub(r"\\(?:mathrm|mathbf|mathit|text|rm)\b\s*", "", tex)
    tex = re.sub(r"\\([A-Za-z]+|%)", lambda m: _NAMED.get(m[1], m[1]), tex)
    tex = re.sub(r"\^(\{[^}]*\}|.)", lambda m: m[1].strip("{}").translate(_RAISED), tex)
    tex = re.sub(r"_(\{[^}]*\}|.)", lambda m: m[1].strip("{}").translate(_LOWERED), tex)
    return re.sub(r"[{}]", "", tex).replace("  ", " ")
