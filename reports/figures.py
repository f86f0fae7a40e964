"""One style for all figures, the scaling and accuracy plots, and saving them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from io import StringIO
from math import lcm
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from matplotlib import rc_context, rcParams
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from matplotlib.transforms import Bbox

from reports.data import Evidence, Outcome
from reports.scaling import Ladder
from reports.traces import behind
from reports.wording import clean, exponent

INK = "#20242a"  #: text and axes; the page replaces it by its own text colour
PAPER = "white"
#: Okabe & Ito's colours without yellow and black: distinct for colour-blind readers.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">")
DASHES = ("-", "--", "-.", (0, (4, 1, 1, 1, 1, 1)), (0, (1, 1)))

STYLE: Any = {
    "font.family": ["STIXGeneral", "DejaVu Sans"],
    "mathtext.fontset": "stix",
    "font.size": 9.5,
    "axes.titlesize": 9.5,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.facecolor": "none",
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "lines.linewidth": 1.1,
    "lines.markersize": 4.5,
    "figure.facecolor": "none",
    "figure.constrained_layout.use": True,
    "savefig.dpi": 220,
    "svg.hashsalt": "mortarbench",
    "svg.fonttype": "path",
    "pdf.fonttype": 42,
}
LEGEND_LINE = 0.21  #: height of a line of a legend, inches
CROWDED = 1000  #: marks; more of them are drawn smaller and let others through
_METADATA: dict[str, dict[str, Any]] = {".pdf": {"CreationDate": None}}
#: The style once all is in place: no figure gets a layout engine again.
_LAID_OUT: Any = STYLE | {"figure.constrained_layout.use": False}
_PAPER_IN_SVG = to_hex(PAPER)
#: Of figures that have been printed; from then on they do not change.
_BOXES: WeakKeyDictionary[Figure, Bbox] = WeakKeyDictionary()
_SVGS: WeakKeyDictionary[Figure, str] = WeakKeyDictionary()


def save(figure: Figure, path: Path) -> Path:
    """Write a figure in the format of the file's ending, the same bytes every time."""
    return save_all(figure, [path])[0]


def save_all(figure: Figure, paths: Sequence[Path]) -> list[Path]:
    """Write a figure in several formats, cut to what is drawn, which is found once."""
    for path in paths:
        if path.suffix == ".svg":
            path.write_text(_svg(figure), "utf-8", newline="\n")
        else:
            _print(figure, path, metadata=_METADATA.get(path.suffix, {}))
    return list(paths)


def inline_svg(figure: Figure, name: str) -> str:
    """Draw a figure as an <svg> element that takes its ink from the page around it.

    It is the drawing of the figure's file, without the paper and framed by the whole
    figure. Identifiers get the prefix `name`, so that several figures fit in one page.
    """
    svg, box = _svg(figure), _box(figure)
    svg = re.sub(r"<(metadata|style)\b.*?</\1>", "", svg, flags=re.DOTALL)
    width, height = (72 * float(inches) for inches in figure.get_size_inches())
    left, top = -72 * box.x0, 72 * box.y1 - height
    head = (
        f'<svg xmlns:xlink="http://www.w3.org/1999/xlink" width="{width:g}pt" '
        f'height="{height:g}pt" viewBox="{left:.6g} {top:.6g} {width:g} {height:g}" '
        'xmlns="http://www.w3.org/2000/svg" version="1.1">'
    )
    svg = head + svg[svg.index(">", svg.index("<svg")) + 1 :]
    svg = svg.replace(f"fill: {_PAPER_IN_SVG}", "fill: none", 1)
    svg = svg.replace(INK, "currentColor")
    svg = re.sub(r'\bid="', f'id="{name}-', svg)
    svg = svg.replace("url(#", f"url(#{name}-")
    return re.sub(r'href="#', f'href="#{name}-', svg)


def _svg(figure: Figure) -> str:
    """Draw a figure as an SVG file, once for its file and the page."""
    if figure not in _SVGS:
        buffer = StringIO()
        _print(figure, buffer, format="svg", metadata={"Date": None})
        _SVGS[figure] = buffer.getvalue()
    return _SVGS[figure]


def _print(figure: Figure, target: Path | StringIO, **how: Any) -> None:
    """Print a figure on paper, cut to what is drawn."""
    box = _box(figure)
    with rc_context(_LAID_OUT):
        figure.savefig(target, bbox_inches=box, facecolor=PAPER, **how)


def _box(figure: Figure) -> Bbox:
    """Place axes and legends, once for every format, and bound what is drawn, inches.

    Without a layout engine, which matplotlib would run again before each format, a
    format costs one drawing instead of two.
    """
    if figure not in _BOXES:
        with rc_context(STYLE):
            if (engine := figure.get_layout_engine()) is not None:
                engine.execute(figure)
                with rc_context(_LAID_OUT):
                    figure.set_layout_engine(None)
            canvas, pad = FigureCanvasAgg(figure), float(rcParams["savefig.pad_inches"])
            renderer = canvas.get_renderer()  # type: ignore[no-untyped-call]
            _BOXES[figure] = figure.get_tightbbox(renderer).padded(pad)
    return _BOXES[figure]


def legible(label: str) -> str:
    """Make a foreign name fit for a figure: letters that the font has, no mathematics.

    matplotlib reads $…$ as a formula and hides labels that begin with an underscore.
    """
    known = "".join(
        c if c.isascii() or "\u00a0" < c <= "\u00ff" else "?" for c in clean(label, 32)
    )
    escaped = known.replace("$", r"\$")
    return f" {escaped}" if escaped.startswith("_") else escaped


def look(index: int, *, line: bool = True) -> dict[str, Any]:
    """Colour, marker and dashes of the index-th solver; distinct in grey print too."""
    rounds = index // lcm(len(COLOURS), len(MARKERS))  # of all pairs that come in turn
    return {
        "color": COLOURS[index % len(COLOURS)],
        "marker": MARKERS[(index + rounds) % len(MARKERS)],
        "linestyle": DASHES[index % len(DASHES)] if line else "none",
    }


def scaling_figure(ladder: Ladder, solvers: Sequence[str]) -> Figure:
    """Draw total time and iterations against n on logarithmic axes."""
    with rc_context(STYLE):
        entries = -(-len(ladder.solvers) // 2)  # lines of the legend
        figure = Figure(figsize=(6.9, 2.4 + LEGEND_LINE * max(entries, 3)))
        left, right = figure.subplots(1, 2)
        for solver in ladder.solvers:
            style = look(solvers.index(solver))
            _times(left, ladder, solver, style=style)
            counted = [
                (n, sum(o.iterations) / 2, o.records)
                for n, o in ladder.curve(solver)
                if o.iterations is not None
            ]
            if counted:
                n, its, runs = zip(*counted, strict=True)
                (line,) = right.plot(n, its, **style)
                behind(line, runs)
        log_log(left, "degrees of freedom $n$", "total time in s")
        _slopes(left)
        log_log(right, "degrees of freedom $n$", "iterations")
        handles, labels = left.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def _times(axes: Axes, ladder: Ladder, solver: str, *, style: dict[str, Any]) -> None:
    """Plot medians with their intervals, and the exponent in the legend."""
    timed = [(n, o.seconds("total")) for n, o in ladder.curve(solver)]
    points = [(n, t.value, t.low, t.high) for n, t in timed if t is not None]
    if not points:
        return
    n, t, low, high = np.array(points, dtype=float).T
    runs = [o.records for _, o in ladder.curve(solver) if o.seconds("total")]
    law = ladder.time_law(solver)
    label = legible(solver) + (f",  p = {exponent(law)}" if law else "")
    (line,) = axes.plot(n, t, label=label, **style)
    _, caps, bars = axes.errorbar(
        n, t, yerr=[t - low, high - t], fmt="none", color=style["color"], capsize=2,
        elinewidth=0.7,
    )  # fmt: skip
    for artist in (line, *caps, *bars):
        behind(artist, runs)


def log_log(axes: Axes, xlabel: str, ylabel: str) -> None:
    """Make both axes logarithmic, with labels that leave each other room."""
    axes.loglog()
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.grid(visible=True, which="major", color="#8a93a0", alpha=0.3, linewidth=0.4)
    axes.set_axisbelow(True)
    for axis in (axes.xaxis, axes.yaxis):
        log_ticks(axis)


def log_ticks(axis: Axis) -> None:
    """Label a logarithmic axis so that labels leave each other room."""
    low, high = axis.get_view_interval()
    decades = np.log10(high / low)
    axis.set_minor_formatter(NullFormatter())
    if decades < 1.8:
        few = LogLocator(subs=(1, 2, 5)) if decades > 0.5 else MaxNLocator(4)
        axis.set_major_locator(few)
        axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))


def _slopes(axes: Axes) -> None:
    """Draw guides of slopes 1 and 3/2 through the lower right of the plot."""
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    start, stop = x0 * (x1 / x0) ** 0.62, x0 * (x1 / x0) ** 0.9
    base = y0 * (y1 / y0) ** 0.04
    for slope, name in ((1.0, "$n$"), (1.5, "$n^{3/2}$")):
        end = base * (stop / start) ** slope
        axes.plot([start, stop], [base, end], color=INK, linewidth=0.6, zorder=1)
        axes.annotate(
            name, (stop, end), xytext=(2, 0), textcoords="offset points", va="center",
            fontsize=8.5,
        )  # fmt: skip
    axes.set(xlim=(x0, x1), ylim=(y0, y1))


def accuracy_figure(evidence: Evidence) -> Figure | None:
    """Draw the accuracy reached against the time spent, verified answers filled."""
    shown = [o for o in evidence.flat if o.worst is not None and o.seconds("total")]
    if not shown:
        return None
    with rc_context(STYLE):
        names = list(dict.fromkeys(o.solver for o in shown))
        figure = Figure(figsize=(6.9, max(3.2, 0.5 + LEGEND_LINE * len(names))))
        axes = figure.subplots()
        crowd = {"markersize": 2.6, "alpha": 0.5} if len(shown) > CROWDED else {}
        for index, solver in enumerate(evidence.solvers):
            mine = [o for o in shown if o.solver == solver]
            style = look(index, line=False) | crowd
            _scatter(axes, [o for o in mine if o.verified], style=style)
            refuted = {**style, "markerfacecolor": "none"}
            _scatter(axes, [o for o in mine if not o.verified], style=refuted)
        axes.axhline(evidence.factor, color=INK, linewidth=0.8)
        axes.annotate(
            "verified below",
            (0.995, evidence.factor),
            xycoords=("axes fraction", "data"),
            xytext=(0, -3),
            textcoords="offset points",
            va="top",
            ha="right",
            fontsize=8.5,
        )
        log_log(axes, "median total time in s", "worst residual / tolerance")
        keys = [
            Line2D([], [], **look(evidence.solvers.index(s), line=False)) for s in names
        ]
        figure.legend(
            keys,
            [legible(s) for s in names],
            loc="outside right upper",
        )
    return figure


def _scatter(axes: Axes, outcomes: list[Outcome], *, style: dict[str, Any]) -> None:
    """Plot (median time, worst residual / tolerance), zero raised to 1e-10."""
    points = [
        (t.value, max((o.worst or 0.0) / o.tol, 1e-10), o.records)
        for o in outcomes
        if (t := o.seconds("total")) is not None
    ]
    if points:
        x, y, runs = zip(*points, strict=True)
        (line,) = axes.plot(x, y, **({"alpha": 0.85} | style))
        behind(line, runs)
