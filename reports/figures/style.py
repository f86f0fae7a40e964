"""Style of all figures, and their files with reproducible bytes."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from mortarbench.harness import InputError
from mortarbench.reports.document import clean

#: Colours of the solvers. The hues of the first eight differ by at least 28°. The first
#: four colours are Okabe and Ito's. Every further colour is the OKLCH colour farthest
#: from all previous ones under normal vision, deuteranopia and protanopia (Machado et
#: al. 2009), with a contrast of at least 2.4 on light and dark pages.
COLOURS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8b6bf7", "#b0a93b", "#e17ffe",
    "#c9212e", "#216e45", "#4851d5", "#b02e9a", "#b775fe", "#698e2f", "#31a3b0",
    "#f34e6c", "#ff72d1", "#ce5dd2", "#c32066", "#008a80", "#6a5ee7", "#77650e",
    "#36b485", "#2c8240", "#889d37", "#859ff6", "#ee6f61", "#288de5", "#f47599",
    "#2063bf", "#067094",
)  # fmt: skip
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">")
DASHES: tuple[Any, ...] = ("-", (0, (3.7, 1.6)), (0, (6.4, 1.6, 1, 1.6)), (0, (1, 1)))
INK = "#20242a"  #: colour of text and axes; a page replaces it by its text colour
WIDTH = 6.9  #: width of a figure, inches
STYLE: Any = {
    "font.family": ["STIXGeneral", "DejaVu Sans"],
    "mathtext.fontset": "stix",
    "font.size": 9.5,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.facecolor": "none",
    "axes.axisbelow": True,
    "axes.grid": True,
    "errorbar.capsize": 2,
    "grid.color": "#8a93a0",
    "grid.alpha": 0.3,
    "grid.linewidth": 0.4,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "lines.linewidth": 1.1,
    "lines.markersize": 4.5,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "figure.facecolor": "none",
    "figure.constrained_layout.use": True,
    "savefig.dpi": 220,
    "savefig.bbox": "tight",
    "svg.hashsalt": "mortarbench",
    "svg.fonttype": "path",
    "pdf.fonttype": 42,
}
ENDINGS = (".pdf", ".svg", ".png")  #: suffixes of figure files
_METADATA: dict[str, dict[str, Any]] = {
    ".pdf": {"CreationDate": None},
    ".svg": {"Date": None},
    ".png": {},
}
_SOLVER = "solver"  #: beginning of the identifiers of artists that belong to a solver


class Drawing(Figure):
    """A figure that notebooks show."""

    def _repr_png_(self) -> bytes:
        content = BytesIO()
        FigureCanvasAgg(self)
        with styled():
            self.savefig(content, format="png", dpi=110, facecolor="white")
        return content.getvalue()


@contextmanager
def styled() -> Iterator[None]:
    """Draw in the style of the reports."""
    with mpl.rc_context(STYLE):
        yield


def panels(
    count: int, *, columns: int = 2, height: float = 2.6, **how: Any
) -> tuple[Figure, list[Axes]]:
    """Return a figure with a grid of panels.

    height : height of a row, inches
    how : further arguments of `Figure.subplots`
    """
    columns = min(columns, count)
    rows = -(-count // columns)
    figure = Drawing(figsize=(WIDTH, height * rows))
    axes = figure.subplots(rows, columns, squeeze=False, **how).ravel().tolist()
    for empty in axes[count:]:
        empty.set_visible(False)
    return figure, axes[:count]


def look(solvers: Sequence[str], solver: str) -> dict[str, Any]:
    """Return colour, marker and dashes of a solver, also distinguishable in grey."""
    k = solvers.index(solver)
    return {
        "color": COLOURS[k % len(COLOURS)],
        "marker": MARKERS[(k + k // 90) % len(MARKERS)],
        "linestyle": DASHES[k % len(DASHES)],
        "label": legible(solver),
        "gid": f"{_SOLVER}{k}",
    }


def curve(
    axes: Axes, x: Any, y: Any, ends: tuple[Any, Any] | None = None, **style: Any
) -> None:
    """Draw points with a line, and error bars between the lower and upper `ends`."""
    axes.plot(x, y, **style)
    if ends is not None:
        for low, high, at, value in zip(*ends, x, y, strict=True):
            if low < value < high:
                axes.plot(
                    [at, at], [low, high], color=style["color"], lw=0.8,
                    gid=style.get("gid"),
                )  # fmt: skip


def logarithmic(axes: Axes, which: str = "both") -> None:
    """Set logarithmic scales, with legible ticks on short axes."""
    for name in ("x", "y") if which == "both" else (which,):
        getattr(axes, f"set_{name}scale")("log")
        axis = getattr(axes, f"{name}axis")
        low, high = getattr(axes, f"get_{name}lim")()
        axis.set_minor_formatter(NullFormatter())
        if 0 < low < high < 60 * low:
            few = MaxNLocator(4, steps=[1, 2, 2.5, 5, 10])
            wide = high > 5 * low
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)) if wide else few)
            axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))


def legend(figure: Figure, axes: Iterable[Axes], columns: int = 4) -> None:
    """Add one legend below the panels, with each label once."""
    handles: dict[str, Any] = {}
    for one in axes:
        for handle, label in zip(*one.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if handles:
        figure.legend(
            handles.values(), handles.keys(), loc="outside lower center", ncols=columns
        )
        # the entries belong to their solvers, as the curves do
        drawn = figure.legends[-1]
        for entry in (drawn.get_texts(), drawn.legend_handles):
            for part, handle in zip(entry, handles.values(), strict=True):
                if part is not None:
                    part.set_gid(handle.get_gid())


def legible(label: str, limit: int = 32) -> str:
    """Replace characters missing in the font, and escape mathematics, in a name."""
    printable = "".join(
        c if c.isascii() or "\u00a0" < c <= "\u00ff" or c in "…×–" else "?"
        for c in clean(label, limit)
    )
    escaped = printable.replace("$", r"\$")
    return f" {escaped}" if escaped.startswith("_") else escaped


def save(figure: Figure, path: Path) -> Path:
    """Write a figure in the format of the file's suffix.

    Raises
    ------
    InputError
        If the suffix is not in `ENDINGS`.

    """
    if path.suffix not in ENDINGS:
        known = ", ".join(sorted(ENDINGS))
        raise InputError(
            f"{path}: unknown picture format {path.suffix!r}; known: {known}"
        )
    FigureCanvasAgg(figure)
    # an SVG file is for pages: transparent, with coloured fields in fewer pixels
    how = (
        {"facecolor": "none", "dpi": 120}
        if path.suffix == ".svg"
        else {"facecolor": "white"}
    )
    with styled():
        figure.savefig(path, metadata=_METADATA[path.suffix], **how)
    return path


def embedded(svg: str, prefix: str, solvers: Sequence[str]) -> str:
    """Return the text of an SVG file for a page.

    Identifiers are made unique by `prefix`. Text and axes take the colour of the page's
    text. Artists of a solver get its class and its name, which a browser shows under
    the pointer.
    """

    def named(match: re.Match[str]) -> str:
        k = int(match[1])
        name = solvers[k].replace("&", "&amp;").replace("<", "&lt;")
        return f'<g class="solver{k}"><title>{name}</title>'

    text = svg[svg.index("<svg") :].replace(INK, "currentColor")
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(rf'<g id="{_SOLVER}(\d+)">', named, text)
    text = re.sub(r'\bid="', f'id="{prefix}-', text)
    text = re.sub(r'(xlink:href="#|url\(#)', rf"\g<1>{prefix}-", text)
    return re.sub(r"\s*\n\s*", "\n", text)
