"""What a figure shows, read back as plain data, so that a page can draw it anew.

The figure stays the only source: whatever draws curves with matplotlib, in this package
or in another, gets a plot that one can zoom in, and the same picture in print. What is
understood: straight and stepped lines, marks, segments (error bars), filled areas,
rectangles, lines across the axes, texts and legends. A figure with anything else
(meshes, colour bars, images) is shown as it is.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex, to_rgba
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.text import Annotation, Text
from matplotlib.ticker import FixedLocator

from reports.figures import INK
from reports.mathtext import plain
from reports.traces import measured

Data = dict[str, Any]

MOST = 4000  #: points of a line; of more, each stretch shows its least and largest


def read_back(figure: Figure, labels: Mapping[str, str]) -> list[Data] | None:
    """List the panels of a figure; None if it holds what cannot be read back.

    labels : of solvers, as legends have them; traces and keys name their positions
    """
    panels = [a for a in figure.axes if a.axison]
    if not panels or not all(map(_readable, panels)):
        return None
    keys = [k for legend in _legends(figure) for k in _keys(legend, labels)]
    rows = [a.get_subplotspec() for a in panels]
    columns = len({None if spec is None else spec.colspan.start for spec in rows})
    groups = [tuple(sorted(map(id, _sharing(a)))) for a in panels]
    return [
        _panel(a, labels, keys) | {"share": groups.index(group), "columns": columns}
        | ({"keys": keys} if i == 0 else {})
        for i, (a, group) in enumerate(zip(panels, groups, strict=True))
    ]  # fmt: skip


def _sharing(axes: Axes) -> list[Axes]:
    return list(axes.get_shared_x_axes().get_siblings(axes))


def _readable(axes: Axes) -> bool:
    known = (Line2D, LineCollection, PolyCollection, Rectangle, Text, Legend)
    mine = [*axes.lines, *axes.collections, *axes.patches, *axes.images, *axes.tables]
    kinds = all(isinstance(artist, known) for artist in mine)
    scales = {axes.get_xscale(), axes.get_yscale()}
    curves = axes.name == "rectilinear" and axes.get_aspect() == "auto"
    return kinds and curves and scales <= {"linear", "log"}


def _panel(axes: Axes, labels: Mapping[str, str], keys: Sequence[Data]) -> Data:
    traces = [{**t, "s": _solver(a, t, labels, keys)} for a, t in _traces(axes)]
    return {
        "title": plain(axes.get_title() or axes.get_title(loc="left")),
        "x": _axis(axes.xaxis),
        "y": _axis(axes.yaxis),
        "height": _height(axes),
        "traces": traces,
        "rules": list(_rules(axes)),
        "texts": list(_texts(axes)),
    }


def _axis(axis: Axis) -> Data:
    """Describe an axis; its ticks only if set by hand, or if there is none."""
    low, high = sorted(axis.get_view_interval())
    at = axis.get_majorticklocs()
    ticks: list[Any] | None = None
    if isinstance(axis.get_major_locator(), FixedLocator):
        names = map(plain, axis.get_major_formatter().format_ticks(list(at)))
        ticks = [[float(v), name] for v, name in zip(at, names, strict=True)]
    elif not len(at):
        ticks = []
    return {
        "label": plain(axis.get_label_text()),
        "log": axis.get_scale() == "log",
        "limits": _numbers((low, high), 9),
        "ticks": ticks,
    }


def _height(axes: Axes) -> float:
    """Height in inches of the whole row that the axes are in."""
    figure, spec = axes.get_figure(), axes.get_subplotspec()
    total = float(figure.get_figheight()) if isinstance(figure, Figure) else 3.0
    if spec is None:
        return total
    given = spec.get_gridspec().get_height_ratios()
    ratios = np.asarray(given, dtype=float)
    rows = slice(spec.rowspan.start, spec.rowspan.stop)
    return round(total * float(ratios[rows].sum() / ratios.sum()), 2)


def _traces(axes: Axes) -> Iterator[tuple[Artist, Data]]:
    """Yield what is drawn in data coordinates, back to front."""
    artists = [*axes.patches, *axes.collections, *axes.lines]
    for artist in sorted(artists, key=lambda a: a.get_zorder()):
        if not artist.get_visible():
            continue
        match artist:
            case Line2D() if artist.get_transform() == axes.transData:
                yield artist, _line(artist)
            case LineCollection():
                yield artist, _segments(artist)
            case PolyCollection():
                outlines = [p.vertices for p in artist.get_paths()]
                colour = _first(artist.get_facecolor())
                yield artist, _area(outlines, colour)
            case Patch() if artist.get_data_transform() == axes.transData:
                path = artist.get_path().transformed(artist.get_patch_transform())
                yield artist, _area([path.vertices], artist.get_facecolor())


def _line(line: Line2D) -> Data:
    x, y = np.asarray(line.get_xydata(), dtype=float).T
    points = measured(line)
    kept = _thinned(y) if len(points) != x.size else np.arange(x.size)
    return {
        **_look(line),
        "kind": "line",
        "step": line.get_drawstyle() == "steps-post",
        "x": _numbers(x[kept]),
        "y": _numbers(y[kept]),
        "runs": _runs(line),
    }


def _runs(artist: Artist) -> list[list[str]]:
    """List the run_ids of every point, or of all (one list), or of none."""
    return [[r.run_id for r in runs] for runs in measured(artist)]


def _thinned(y: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Choose the least and largest of every stretch of a long line, and its ends."""
    if y.size <= MOST:
        return np.arange(y.size)
    size = -(-2 * y.size // MOST)
    kept = {0, y.size - 1}
    for start in range(0, y.size, size):
        stretch = np.nan_to_num(y[start : start + size], nan=-np.inf)
        kept |= {start + int(stretch.argmin()), start + int(stretch.argmax())}
    return np.array(sorted(kept))


def _look(line: Line2D) -> Data:
    marker = str(line.get_marker() or "None")
    drawn = line.get_linestyle() not in ("None", "none", " ", "")
    return {
        "colour": _colour(line.get_color()),
        "marker": "" if marker.lower() in ("none", " ", "") else marker,
        "hollow": to_rgba(line.get_markerfacecolor())[3] == 0,
        "dash": _dash(line) if drawn else None,
        "width": round(float(line.get_linewidth()), 2),
        "size": round(float(line.get_markersize()), 2),
        "opacity": 1.0 if line.get_alpha() is None else line.get_alpha(),
    }


def _dash(line: Line2D) -> str:
    """Lengths of dashes and gaps in px; empty for a line without gaps."""
    _, pattern = line._dash_pattern  # type: ignore[attr-defined]  # has no public name
    return " ".join(f"{v:.3g}" for v in pattern or ())


def _segments(lines: LineCollection) -> Data:
    ends = np.array([s[[0, -1]] for s in lines.get_segments() if len(s) > 1])
    ends = ends.reshape(-1, 4).astype(float)
    return {
        "kind": "segments",
        "colour": _colour(_first(lines.get_edgecolor())),
        "width": round(float(np.ravel(lines.get_linewidth())[0]), 2),
        "ends": [_numbers(row) for row in ends],
        "runs": _runs(lines),
    }


def _area(outlines: Sequence[Any], colour: Any) -> Data:
    return {
        "kind": "area",
        "colour": _colour(colour),
        "opacity": round(float(to_rgba(colour)[3]), 3),
        "outlines": [_numbers(np.ravel(v)) for v in outlines],
    }


def _colour(colour: Any) -> str:
    """Name a colour as SVG does; ink is that of the text around."""
    name = to_hex(colour)
    return "currentColor" if name == INK else name


def _first(colours: Any) -> Any:
    rows = np.atleast_2d(colours)
    return rows[0] if len(rows) else (0, 0, 0, 0)


def _rules(axes: Axes) -> Iterator[Data]:
    """Yield lines across the axes, which have one coordinate each."""
    for line in axes.lines:
        if line.get_transform() == axes.get_yaxis_transform(which="grid"):
            at = ("y", line.get_ydata(orig=False))
        elif line.get_transform() == axes.get_xaxis_transform(which="grid"):
            at = ("x", line.get_xdata(orig=False))
        else:
            continue
        yield _look(line) | {"axis": at[0], "at": float(np.asarray(at[1])[0])}


def _texts(axes: Axes) -> Iterator[Data]:
    for text in axes.texts:
        coords = getattr(text, "xycoords", "data")
        modes = coords if isinstance(coords, tuple) else (coords, coords)
        if not set(modes) <= {"data", "axes fraction"} or not text.get_visible():
            continue
        place = text.xy if isinstance(text, Annotation) else text.get_position()
        yield {
            "text": plain(text.get_text()),
            "place": [float(v) for v in place],
            "inside": [mode != "data" for mode in modes],
            "align": [text.get_horizontalalignment(), text.get_verticalalignment()],
        }


def _legends(figure: Figure) -> list[Legend]:
    inner = [a.get_legend() for a in figure.axes]
    return [*figure.legends, *(one for one in inner if one is not None)]


def _keys(legend: Legend, labels: Mapping[str, str]) -> Iterator[Data]:
    for handle, text in zip(legend.legend_handles, legend.get_texts(), strict=False):
        if isinstance(handle, Line2D):
            look = _look(handle)
        elif isinstance(handle, Patch):
            look = {"colour": _colour(handle.get_facecolor()), "marker": "s",
                    "hollow": False, "dash": None, "width": 1, "size": 6}  # fmt: skip
        else:
            continue
        label = text.get_text()
        yield look | {"label": plain(label), "s": _named(label, labels)}


def _named(label: str, labels: Mapping[str, str]) -> int:
    """Position of the solver that a label begins with; −1 if it names none."""
    fits = [
        (len(one), i)
        for i, one in enumerate(labels.values())
        if label == one
        or re.match(r"[,:;]? ", label[len(one) :] * label.startswith(one))
    ]
    return max(fits)[1] if fits else -1


def _solver(
    artist: Artist, trace: Data, labels: Mapping[str, str], keys: Sequence[Data]
) -> int:
    """Find whose a trace is: by its runs, its label, or the key that it looks like."""
    owners = {r.solver for runs in measured(artist) for r in runs}
    if len(owners) == 1:
        return [*labels].index(owners.pop())
    by_label = _named(str(artist.get_label()), labels)
    if by_label >= 0:
        return by_label
    for alike in (("colour", "marker"), ("colour", "dash"), ("colour",)):
        places = {
            k["s"] for k in keys if all(k[name] == trace.get(name) for name in alike)
        }
        if len(places) == 1:
            return int(places.pop())
    return -1


def _numbers(values: Any, digits: int = 6) -> list[float | None]:
    """Round for the page; what is not finite has no place in JSON."""
    return [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in values]
