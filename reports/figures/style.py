"""One style for all figures: colours, marks, logarithmic axes, legible labels."""

from __future__ import annotations

from math import lcm
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from reports.document.formatting import clean

INK = "#20242a"  #: text and axes; the page replaces it by its own text colour
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
