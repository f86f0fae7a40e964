"""Figure of the certified error of every answer, one row of marks per solver."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from mortarbench.reports.document.figure import (
    INK,
    Axis,
    Figure,
    Key,
    Look,
    Panel,
    Row,
    Rule,
    Series,
    Text,
    categories,
)
from mortarbench.reports.document.formatting import tolerance
from mortarbench.reports.figures.style import COLOURS, below, legible

_SPREAD = 0.3  #: largest vertical offset of marks in a row, so that none is hidden
_FLOOR = 1e-17  #: value at which errors of zero are drawn
_LIMIT = Look(colour=INK, width=0.6, dash=(4, 2))

Answer = Mapping[str, Any]


_DOT = Look(colour=COLOURS[0], marker="o", dash=None, size=3.6, edge=0.6)
_RING = Look(colour=COLOURS[0], marker="o", dash=None, size=3.6, edge=0.6, fill="none")
_CROSS = Look(colour=COLOURS[1], marker="X", dash=None, size=5.8, edge=0.6)


def _refuted(a: Answer) -> bool:
    return bool(a["outcome"] == "refuted")


_KINDS: tuple[tuple[str, Callable[[Answer], bool], Look], ...] = (
    ("primal form", lambda a: not _refuted(a) and a["form"] == "primal", _RING),
    ("dual or other form", lambda a: not _refuted(a) and a["form"] != "primal", _DOT),
    ("refuted", _refuted, _CROSS),
)


def error_figure(answers: Sequence[Answer], tol: float) -> Figure | None:
    """Draw the errors of the answers at one tolerance; None if there are no answers.

    answers : answers in the data returned by `validate`
    """
    known = [a for a in answers if a["tol"] == tol and a["bound"] is not None]
    if not known:
        return None
    solvers = sorted({a["solver"] for a in known})
    marks, keys = [], []
    for words, keep, look in _KINDS:
        chosen = [a for a in known if keep(a)]
        if chosen:
            keys.append(Key(label=words, look=look))
        for solver in dict.fromkeys(a["solver"] for a in chosen):
            mine = [a for a in chosen if a["solver"] == solver]
            marks.append(
                Series(
                    x=tuple(max(a["bound"], _FLOOR) for a in mine),
                    y=tuple(_shift(known, a) - solvers.index(solver) for a in mine),
                    runs=tuple((a["run_id"],) for a in mine),
                    look=look,
                    solver=solver,
                    clipped=False,
                )
            )
    rules, texts = [], []
    for at, text in (
        (tol, f"t = {tolerance(tol)}"),
        (min(np.sqrt(20 * tol), np.sqrt(0.2)), "√(20t), largest allowed"),
    ):
        rules.append(Rule(axis="x", at=at, look=_LIMIT))
        texts.append(
            Text(
                text=text,
                place=(at, 1),
                inside=(False, True),
                offset=(0, 3),
                align=("center", "bottom"),
            )
        )
    panel = Panel(
        x=Axis(label="certified relative error in the energy norm", log=True),
        y=categories([legible(s) for s in solvers]),
        marks=tuple(marks),
        rules=tuple(rules),
        texts=tuple(texts),
        grid="y",
    )
    return Figure(
        rows=(Row(panels=(panel,)),),
        height=1.3 + 0.24 * len(solvers),
        legend=below(keys, 3),
    )


def _shift(answers: Sequence[Answer], a: Answer) -> float:
    """Spread the marks of a solver evenly, in the order of its answers."""
    own = [b["run_id"] for b in answers if b["solver"] == a["solver"]]
    places = np.linspace(-_SPREAD, _SPREAD, len(own)) if len(own) > 1 else [0.0]
    return float(places[own.index(a["run_id"])])
