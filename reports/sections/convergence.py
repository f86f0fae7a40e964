"""Section on convergence histories: choice of cases, figures and captions."""

from __future__ import annotations

from collections.abc import Iterator

from mortarbench.reports.data.histories import RULE, chosen, unread
from mortarbench.reports.document.layout import Part, Picture
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.figures.convergence import (
    FLOOR,
    active_set_figure,
    convergence_figure,
    marked,
)
from mortarbench.reports.sections import Analysis, section

TEXT = Sentences(__name__, FLOOR=FLOOR, RULE=RULE)


@section(
    54,
    "convergence",
    "Convergence",
    "Convergence: no solver stored a history of its iterations. Solvers with the "
    "option “history” store one if the suite sets history = true.",
)
def convergence(a: Analysis) -> Iterator[Part]:
    """Draw the cases that `RULE` selects; yield nothing if no history is stored."""
    pictures = []
    for i, c in enumerate(chosen(a.evidence), 1):
        facts = {
            "one": c.runs[0].outcome,
            "runs": ", ".join(run.record.identity for run in c.runs),
            "over": "products with P" if c.counted else "iterations",
            "ends": any(run.outer_ends.any() for run in c.runs),
        }
        if figure := convergence_figure(c):
            gradient = any(run.gradient is not None for run in c.runs)
            error = any(run.infeasibility is not None for run in c.runs)
            caption = TEXT("convergence", facts, marked(c), gradient, error)
            name = f"convergence-{i}"
            pictures.append(Picture(name=name, caption=caption, figure=figure))
        if figure := active_set_figure(c):
            caption = TEXT(
                "active", facts, any(r.two_sided is not None for r in c.runs)
            )
            name = f"active-set-{i}"
            pictures.append(Picture(name=name, caption=caption, figure=figure))
    lost = unread(a.evidence)
    if pictures or lost:
        yield from TEXT.parts("prose", lost)
    yield from pictures
