"""One drawn thing as plain data: lines, segments, areas, rules and texts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex, to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Annotation

from reports.figures.provenance import measured
from reports.figures.style import INK
from reports.render.mathtext import plain

Data = dict[str, Any]

MOST = 4000  #: points of a line; of more, each stretch shows its least and largest


def traces(axes: Axes) -> Iterator[tuple[Artist, Data]]:
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
        **look_of(line),
        "kind": "line",
        "step": line.get_drawstyle() == "steps-post",
        "few": line.get_markevery() is not None,
        "x": numbers(x[kept]),
        "y": numbers(y[kept]),
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


def look_of(line: Line2D) -> Data:
    """Tell how a line and its marks look, lengths in px or points."""
    marker = str(line.get_marker() or "None")
    drawn = line.get_linestyle() not in ("None", "none", " ", "")
    return {
        "colour": colour_of(line.get_color()),
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
        "colour": colour_of(_first(lines.get_edgecolor())),
        "width": round(float(np.ravel(lines.get_linewidth())[0]), 2),
        "ends": [numbers(row) for row in ends],
        "runs": _runs(lines),
    }


def _area(outlines: Sequence[Any], colour: Any) -> Data:
    return {
        "kind": "area",
        "colour": colour_of(colour),
        "opacity": round(float(to_rgba(colour)[3]), 3),
        "outlines": [numbers(np.ravel(v)) for v in outlines],
    }


def colour_of(colour: Any) -> str:
    """Name a colour as SVG does; ink is that of the text around."""
    name = to_hex(colour)
    return "currentColor" if name == INK else name


def _first(colours: Any) -> Any:
    rows = np.atleast_2d(colours)
    return rows[0] if len(rows) else (0, 0, 0, 0)


def rules(axes: Axes) -> Iterator[Data]:
    """Yield lines across the axes, which have one coordinate each."""
    for line in axes.lines:
        if line.get_transform() == axes.get_yaxis_transform(which="grid"):
            at = ("y", line.get_ydata(orig=False))
        elif line.get_transform() == axes.get_xaxis_transform(which="grid"):
            at = ("x", line.get_xdata(orig=False))
        else:
            continue
        yield look_of(line) | {"axis": at[0], "at": float(np.asarray(at[1])[0])}


def texts(axes: Axes) -> Iterator[Data]:
    """Yield the texts within the axes, placed by data or by parts of the axes."""
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


def numbers(values: Any, digits: int = 6) -> list[float | None]:
    """Round for the page; what is not finite has no place in JSON."""
    return [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in values]
