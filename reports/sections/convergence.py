"""The section on how solvers got there: which cases, which figures, what they show."""

from __future__ import annotations

from mortarbench.reports.data.evidence import Evidence
from mortarbench.reports.data.histories import RULE, CaseHistories, chosen, unread
from mortarbench.reports.document.formatting import clean, listing, tolerance
from mortarbench.reports.document.layout import Picture, Section
from mortarbench.reports.figures.convergence import (
    FLOOR,
    active_set_figure,
    convergence_figure,
    marked,
)


def convergence(evidence: Evidence) -> Section | None:
    """Draw the cases that `RULE` chooses; None where no solver kept a history."""
    pictures: list[Picture] = []
    for i, comparison in enumerate(chosen(evidence), 1):
        pictures += _pictures(comparison, i)
    lost = unread(evidence)
    if not pictures and not lost:
        return None
    prose = [
        "What solvers that keep a history tell of their iterations: their own account, "
        f"in their own norms, on which no verdict rests. {RULE}"
    ]
    if lost:
        prose.append(f"Histories that could not be read: {listing(lost)}.")
    return Section(
        name="convergence",
        title="Convergence",
        prose=tuple(prose),
        pictures=tuple(pictures),
    )


def _pictures(c: CaseHistories, i: int) -> list[Picture]:
    """Make the figures of one case: convergence, active set, or one of them."""
    one = c.runs[0].outcome
    where = f"{clean(one.case)} at tol {tolerance(one.tol)}"
    runs = clean(", ".join(run.record.run_id for run in c.runs), 200)
    over = "products with P" if c.counted else "iterations"
    ticks = (
        " Ticks: ends of outer iterations; solvers from top to bottom as in the key."
        if any(run.outer_ends.any() for run in c.runs)
        else ""
    )
    pictures = []
    if figure := convergence_figure(c):
        kinds = marked(c)
        marks = (
            f" Marks, where they do not overlap: {', '.join(kinds)} steps."
            if kinds
            else ""
        )
        caption = (
            f"Convergence on {where}: {_quantities(c)}, over {over}. What is "
            f"below {FLOOR:g} tol is not drawn.{marks}{ticks} Runs {runs}."
        )
        name = f"convergence-{i}"
        pictures.append(Picture(name=name, caption=caption, figure=figure))
    if figure := active_set_figure(c):
        slipping = (
            " Below, those of variables between two bounds: in a dual with friction "
            "the rows that slip."
            if any(run.two_sided is not None for run in c.runs)
            else ""
        )
        caption = (
            f"Active bounds on {where}, over {over}.{slipping}{ticks} Runs {runs}."
        )
        pictures.append(Picture(name=f"active-set-{i}", caption=caption, figure=figure))
    return pictures


def _quantities(c: CaseHistories) -> str:
    gradient = "norm of the projected gradient relative to its first value"
    error = "relative infeasibility ‖Ax − b‖"
    shown = [gradient] * any(one.gradient is not None for one in c.runs)
    shown += [error] * any(one.infeasibility is not None for one in c.runs)
    return " and ".join(shown)
