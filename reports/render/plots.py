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
from matplotlib.figure import Figure, SubFigure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.text import Text
from matplotlib.ticker import FixedLocator

from reports.figures.provenance import measured
from reports.render.artists import (
    Data,
    colour_of,
    look_of,
    numbers,
    rules,
    texts,
    traces,
)
from reports.render.mathtext import plain


def read_back(figure: Figure, labels: Mapping[str, str]) -> list[Data] | None:
    """List the panels of a figure; None if it holds what cannot be read back.

    labels : of solvers, as legends have them; traces and keys name their positions
    """
    panels = [a for a in figure.axes if a.axison]
    if not panels or not all(map(_readable, panels)):
        return None
    common = _legend(_legends(figure), labels)
    rows = [a.get_subplotspec() for a in panels]
    columns = len({None if spec is None else spec.colspan.start for spec in rows})
    groups = [tuple(sorted(map(id, _sharing(a)))) for a in panels]
    return [
        _panel(a, labels, common["keys"])
        | {"share": groups.index(group), "columns": columns}
        | ({"common": common} if i == 0 else {})
        for i, (a, group) in enumerate(zip(panels, groups, strict=True))
    ]


def _sharing(axes: Axes) -> list[Axes]:
    return list(axes.get_shared_x_axes().get_siblings(axes))


def _readable(axes: Axes) -> bool:
    known = (Line2D, LineCollection, PolyCollection, Rectangle, Text, Legend)
    mine = [*axes.lines, *axes.collections, *axes.patches, *axes.images, *axes.tables]
    kinds = all(isinstance(artist, known) for artist in mine)
    scales = {axes.get_xscale(), axes.get_yscale()}
    curves = axes.name == "rectilinear" and axes.get_aspect() == "auto"
    return kinds and curves and scales <= {"linear", "log"}


def _panel(axes: Axes, labels: Mapping[str, str], common: Sequence[Data]) -> Data:
    inner = axes.get_legend()
    own = _legend([] if inner is None else [inner], labels)
    keys = [*own["keys"], *common]
    drawn = [{**t, "s": _solver(a, t, labels, keys)} for a, t in traces(axes)]
    owners: dict[str, set[int]] = {}
    for t in drawn:
        owners.setdefault(t["colour"], set()).add(t["s"])
    for t in drawn:  # bands and caps, which have no key, go with the line of a colour
        others = owners[t["colour"]] - {-1}
        t["s"] = others.pop() if t["s"] < 0 and len(others) == 1 else t["s"]
    return {
        "title": plain(axes.get_title() or axes.get_title(loc="left")),
        "x": _axis(axes.xaxis),
        "y": _axis(axes.yaxis),
        "height": _height(axes),
        "traces": drawn,
        "rules": list(rules(axes)),
        "texts": list(texts(axes)),
        "own": own,
    }


def _axis(axis: Axis) -> Data:
    """Describe an axis; its ticks only if set by hand, or if there is none."""
    low, high = sorted(axis.get_view_interval())
    at = axis.get_majorticklocs()
    ticks: list[Any] | None = None
    if isinstance(axis.get_major_locator(), FixedLocator):
        names = [plain(n) for n in axis.get_major_formatter().format_ticks(list(at))]
        if not any(map(_number, names)):
            ticks = [[float(v), name] for v, name in zip(at, names, strict=True)]
    elif not len(at):
        ticks = []
    return {
        "label": plain(axis.get_label_text()),
        "log": axis.get_scale() == "log",
        "limits": numbers((low, high), 9),
        "ticks": ticks,
        "numbered": bool(axis.get_tick_params().get("labelbottom", True)),
    }


def _number(name: str) -> bool:
    return re.fullmatch(r"[-−]?[\d.]+", name) is not None


def _height(axes: Axes) -> float:
    """Height in inches of the whole row that the axes are in."""
    figure, spec = axes.get_figure(), axes.get_subplotspec()
    total = float(figure.bbox.height / figure.dpi) if figure is not None else 3.0
    if spec is None:
        return total
    given = spec.get_gridspec().get_height_ratios()
    ratios = np.asarray(given, dtype=float)
    rows = slice(spec.rowspan.start, spec.rowspan.stop)
    return round(total * float(ratios[rows].sum() / ratios.sum()), 2)


def _legends(figure: Figure | SubFigure) -> list[Legend]:
    """List the legends of a figure and its parts, not those inside of axes."""
    parts = [legend for part in figure.subfigs for legend in _legends(part)]
    return [*figure.legends, *parts]


def _legend(legends: Sequence[Legend], labels: Mapping[str, str]) -> Data:
    titles = dict.fromkeys(plain(one.get_title().get_text()) for one in legends)
    return {
        "title": ", ".join(filter(None, titles)),
        "keys": [key for one in legends for key in _keys(one, labels)],
    }


def _keys(legend: Legend, labels: Mapping[str, str]) -> Iterator[Data]:
    for handle, text in zip(legend.legend_handles, legend.get_texts(), strict=False):
        if isinstance(handle, Line2D):
            look = look_of(handle)
        elif isinstance(handle, Patch):
            look = {"colour": colour_of(handle.get_facecolor()), "marker": "s",
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
