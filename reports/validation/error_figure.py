"""The certified error of every answer, a line of marks per solver."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from reports.document.formatting import tolerance
from reports.figures.style import COLOURS, INK, STYLE, legible

_SPREAD = 0.3  #: of the marks of a solver, up and down, so that none hides another
_FLOOR = 1e-17  #: where errors of zero are drawn


def _refuted(a: Mapping[str, Any]) -> bool:
    return bool(a["refuted"])


def _of_primal(a: Mapping[str, Any]) -> bool:
    return not a["refuted"] and a["form"] == "primal"


def _of_others(a: Mapping[str, Any]) -> bool:
    return not a["refuted"] and a["form"] != "primal"


_KINDS: Any = (
    (
        "primal form",
        _of_primal,
        {"s": 13, "edgecolor": COLOURS[0], "facecolor": "none"},
    ),
    ("dual or other form", _of_others, {"s": 13, "color": COLOURS[0]}),
    ("refuted", _refuted, {"s": 34, "color": COLOURS[1], "marker": "X"}),
)


def error_figure(answers: Sequence[Mapping[str, Any]], tol: float) -> Figure | None:
    """Draw the errors of the answers at one tolerance; None where none is known.

    answers : as in the data of a cross-validation
    """
    known = [a for a in answers if a["tol"] == tol and a["error"] is not None]
    if not known:
        return None
    solvers = sorted({a["solver"] for a in known}, reverse=True)
    with rc_context(STYLE):
        figure = Figure(figsize=(6.9, 1.3 + 0.24 * len(solvers)))
        axes = figure.subplots()
        for words, keep, style in _KINDS:
            chosen = [a for a in known if keep(a)]
            if not chosen:
                continue
            axes.scatter(
                [max(a["error"], _FLOOR) for a in chosen],
                [solvers.index(a["solver"]) + _shift(known, a) for a in chosen],
                label=words, clip_on=False, zorder=2, linewidth=0.6, **style,
            )  # fmt: skip
        for at, text in (
            (tol, f"t = {tolerance(tol)}"),
            (known[0]["energy_allowed"], "√(20t), allowed"),
        ):
            axes.axvline(at, color=INK, linewidth=0.6, linestyle=(0, (4, 2)), zorder=1)
            axes.annotate(
                text, (at, 1), xycoords=("data", "axes fraction"), xytext=(0, 3),
                textcoords="offset points", ha="center", fontsize=8.5,
            )  # fmt: skip
        axes.set_xscale("log")
        axes.set_yticks(range(len(solvers)), [legible(s) for s in solvers])
        axes.set_ylim(-0.6, len(solvers) - 0.4)
        axes.tick_params(axis="y", length=0)
        axes.set_xlabel("certified relative error in the energy norm")
        axes.grid(axis="y", linewidth=0.3, alpha=0.5)
        figure.legend(loc="outside lower center", ncols=3, handletextpad=0.2)
    return figure


def _shift(answers: Sequence[Mapping[str, Any]], a: Mapping[str, Any]) -> float:
    """Spread the marks of a solver evenly, in the order of its answers."""
    own = [b["run_id"] for b in answers if b["solver"] == a["solver"]]
    places = np.linspace(-_SPREAD, _SPREAD, len(own)) if len(own) > 1 else [0.0]
    return float(places[own.index(a["run_id"])])
