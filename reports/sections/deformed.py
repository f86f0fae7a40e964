"""The deformed bodies of the largest verified case."""

from __future__ import annotations

import os

from harness import Fields, InputError
from harness.files.store import load_fields
from reports.data.evidence import Evidence, Outcome
from reports.document.formatting import clean, tolerance
from reports.document.layout import Picture, Section
from reports.figures.deformed import PERCENTILE, SCALE, clipped_at, deformed_figure


def deformed(evidence: Evidence) -> Section | None:
    """Draw the largest verified case; None where no deformed state was stored."""
    drawable = [o for o in evidence.flat if o.verified and o.first.fields]
    if not drawable:
        return None
    chosen = max(drawable, key=_importance)
    try:
        fields = load_fields(evidence.directory, chosen.first.fields or "")
        figure = deformed_figure(fields)
    except InputError as e:  # the journal alone must do
        missing = str(e).removeprefix(f"{evidence.directory}{os.sep}")
        why = f"There is no picture of {clean(chosen.case)}: {clean(missing, 200)}."
        return Section(name="deformed", title="Deformed bodies", prose=(why,))
    picture = Picture(name="deformed", caption=_caption(chosen, fields), figure=figure)
    return Section(name="deformed", title="Deformed bodies", pictures=(picture,))


def _importance(outcome: Outcome) -> tuple[float, float, float, str, str]:
    """Order by size, then load step, then accuracy; names break ties."""
    step = outcome.first.params.get("step", 0)
    size = outcome.size("dofs") or 0
    last = float(step) if isinstance(step, int | float) else 0.0
    return (size, last, -outcome.tol, outcome.first.form, outcome.solver)


def _caption(outcome: Outcome, fields: Fields) -> str:
    caption = (
        f"{clean(outcome.case)}: the largest verified case, as answered by "
        f"{clean(outcome.solver, 40)} at tol {tolerance(outcome.tol)} (run "
        f"{clean(outcome.run_ids[0], 40)}). Displacements are drawn to scale "
        f"(factor {SCALE:g})."
    )
    limits = clipped_at(fields)
    if limits is None:
        return caption
    return (
        f"{caption} Colours: patch-recovered von Mises stress, one scale for all "
        f"bodies, clipped at the {PERCENTILE:g} % quantile of the nodal values "
        f"({limits[0] / 1e9:.3g} GPa), since stresses may be singular at clamped and "
        f"loaded corners; the largest nodal value is {limits[1] / 1e9:.3g} GPa."
    )
