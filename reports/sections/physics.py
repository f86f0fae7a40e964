"""Physical results of verified answers: energies, quantities, deformed bodies."""

from __future__ import annotations

import os
from collections.abc import Sequence

from mortarbench.harness import Fields, InputError
from mortarbench.harness.files.store import load_fields
from mortarbench.reports.data.cells import source
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.data.quantities import (
    Spread,
    best_of,
    elastic,
    head,
    leaves,
    quantity,
    spreads,
    unit,
)
from mortarbench.reports.document.formatting import (
    clean,
    plural,
    power,
    significant,
    tolerance,
)
from mortarbench.reports.document.layout import Cell, Picture, Section, Table, name_cell
from mortarbench.reports.figures.deformed import (
    PERCENTILE,
    SCALE,
    automatic_scale,
    clipped_at,
    deformed_figure,
)
from mortarbench.reports.figures.tractions import traction_figure


def agreement(evidence: Evidence) -> Section | None:
    """Show how closely verified answers agree; None where no case has an energy."""
    found = spreads(evidence.flat)
    if not found:
        return None
    compared = [s for s in found if s.relative is not None]
    prose = [
        "Potential energy of the recovered displacement. Every verified answer is set "
        "against every other one of the same physical case, across solvers and across "
        "primal and dual forms; none serves as the reference.",
    ]
    if compared:
        worst = max(compared, key=lambda s: s.relative or 0.0)
        prose.append(
            f"The largest relative difference is {power(worst.relative)}, on "
            f"{clean(worst.answers[0].physical)} at tol "
            f"{tolerance(worst.answers[0].tol)}."
        )
    return Section(
        name="energies",
        title="Agreement of energies",
        prose=tuple(prose),
        tables=(
            Table(
                caption="Energies of verified answers and their largest pairwise "
                "difference. The energy is that of the answer with the smallest "
                "worst residual, in as many digits as the answers agree on and one "
                "more, at most 12.",
                columns=(
                    "physical case", "tol", "answers", "energy",
                    "largest relative difference", "between",
                ),
                rows=tuple(map(_spread_row, found)),
            ),
        ),
    )  # fmt: skip


def _spread_row(s: Spread) -> tuple[Cell, ...]:
    first = s.answers[0]
    between = " and ".join(map(_who, s.pair)) if s.pair else "nothing to compare with"
    return (
        name_cell(first.physical),
        Cell(text=tolerance(first.tol), value=first.tol),
        Cell(text=str(len(s.answers)), value=len(s.answers), title=source(*s.answers)),
        Cell(
            text=significant(s.best.energy, s.digits),
            after=unit(s.best, "energy"),
            value=s.best.energy,
            title=source(s.best),
        ),
        Cell(text=power(s.relative), value=s.relative, title=source(*(s.pair or ()))),
        Cell(text=between, kind="words"),
    )


def _who(outcome: Outcome) -> str:
    form = outcome.first.form
    return clean(f"{outcome.solver} on {form}" if form else outcome.solver, 60)


def physics(evidence: Evidence) -> Section | None:
    """Show sizes and physical results, one verified answer per physical case."""
    groups: dict[str, list[Outcome]] = {}
    for o in evidence.flat:
        if o.verified and o.quantities:
            groups.setdefault(o.physical, []).append(o)
    if not groups:
        return None
    chosen = [(best_of(answers), answers) for answers in groups.values()]
    tables = []
    for family in dict.fromkeys(best.first.family for best, _ in chosen):
        mine = [(b, answers) for b, answers in chosen if b.first.family == family]
        tables += [
            _quantities(mine, family, sizes=True),
            _quantities(mine, family, sizes=False),
        ]
    si = " Units are SI." if any(elastic(o) for o, _ in chosen) else ""
    si += " A number without a unit is dimensionless, or in that of its file."
    return Section(
        name="physics",
        title="Physical results",
        prose=(
            "One answer per physical case: of all verified ones that with the smallest "
            "worst residual; the last column says whose. Numbers have as many digits "
            "as the verified answers at the same tolerance agree on, and one more; a "
            f"lone answer has as many as its tolerance promises.{si}",
        ),
        tables=tuple(t for t in tables if t is not None),
    )


def _quantities(
    chosen: Sequence[tuple[Outcome, list[Outcome]]], family: str, *, sizes: bool
) -> Table | None:
    outcomes = [best for best, _ in chosen]
    paths = list(dict.fromkeys(p for o in outcomes for p in leaves(o, sizes=sizes)))
    if not paths:
        return None
    rows = []
    for best, answers in chosen:
        own = leaves(best, sizes=sizes)
        peers = [leaves(o, sizes=sizes) for o in answers if o.tol == best.tol]
        which = f"{_who(best)}, {power(best.worst)} at tol {tolerance(best.tol)}"
        answer = Cell(text=which, kind="words", title=source(best))
        cells = [quantity(path, best, own.get(path), peers) for path in paths]
        rows.append((name_cell(best.physical), *cells, *([] if sizes else [answer])))
    what = "Sizes" if sizes else "Physical results"
    return Table(
        caption=f"{what} of {clean(family, 40)}: {plural(len(rows), 'case')}.",
        notes=_caveats({path[0] for path in paths}),
        columns=(
            "physical case",
            *(head(path, outcomes) for path in paths),
            *([] if sizes else ["answer of"]),
        ),
        rows=tuple(rows),
    )


def _caveats(names: set[str]) -> tuple[str, ...]:
    """Say what the numbers of a table do not mean."""
    found = []
    if "active" in names:
        found.append(
            "active: rows with λ_i > 1e-6 max λ; a range where verified answers differ "
            "on it, as they do where a multiplier is below the accuracy asked for."
        )
    if "max_von_mises" in names:
        singular = ", being singular under the point load" if "tip" in names else ""
        found.append(
            "max von Mises: the largest nodal value, to three digits; it depends on "
            f"the mesh{singular}."
        )
    if "tip" in names:
        found.append(
            "A point load makes tip displacement and energy mesh-dependent too: they "
            "grow without bound as the mesh is refined; compare them on one mesh only."
        )
    return tuple(found)


def deformed(evidence: Evidence) -> Section | None:
    """Draw the largest verified case; None where no deformed state was stored."""
    drawable = [o for o in evidence.flat if o.verified and o.first.fields]
    if not drawable:
        return None
    chosen = max(drawable, key=_importance)
    try:
        fields = load_fields(evidence.directory, chosen.first.fields or "")
        if not len(fields.cells):  # half planes only
            return None
        figure = deformed_figure(fields)
    except InputError as e:  # the journal alone must do
        missing = str(e).removeprefix(f"{evidence.directory}{os.sep}")
        why = f"There is no picture of {clean(chosen.case)}: {clean(missing, 200)}."
        return Section(name="deformed", title="Deformed bodies", prose=(why,))
    picture = Picture(
        name="deformed", caption=_deformed_caption(chosen, fields), figure=figure
    )
    return Section(name="deformed", title="Deformed bodies", pictures=(picture,))


def tractions(evidence: Evidence) -> Section | None:
    """Draw tractions along contacts; None where no deformed state holds any.

    Of each family the largest verified case.
    """
    largest: dict[str, Outcome] = {}
    for o in evidence.flat:
        if o.verified and o.first.fields:
            family = o.first.family
            largest[family] = max(o, largest.get(family, o), key=_importance)
    pictures = []
    for family, chosen in largest.items():
        try:
            fields = load_fields(evidence.directory, chosen.first.fields or "")
        except InputError:  # `deformed` says so
            continue
        if (figure := traction_figure(fields)) is not None:
            pictures.append(
                Picture(
                    name=f"tractions-{family}",
                    caption=_traction_caption(chosen, fields),
                    figure=figure,
                )
            )
    if not pictures:
        return None
    return Section(
        name="tractions", title="Tractions along the contact", pictures=tuple(pictures)
    )


def _traction_caption(outcome: Outcome, fields: Fields) -> str:
    sides = fields.contacts
    rough = any(side.friction is not None for side in sides)
    known = any(side.exact is not None for side in sides)
    return (
        f"{clean(outcome.case)}, the largest verified case of its family, as answered "
        f"by {clean(outcome.solver, 40)} at tol {tolerance(outcome.tol)} (run "
        f"{clean(outcome.run_ids[0], 40)}): pressure"
        + (" and shear traction, along the tangent (-n_y, n_x)," if rough else "")
        + " at the slave nodes, by the distance along the side from its middle."
        + (" Lines: the exact solution." if known else "")
    )


def _importance(outcome: Outcome) -> tuple[float, float, float, str, str]:
    """Order by size, then load step, then accuracy; names break ties."""
    step = outcome.first.params.get("step", 0)
    size = outcome.size("dofs") or 0
    last = float(step) if isinstance(step, int | float) else 0.0
    return (size, last, -outcome.tol, outcome.first.form, outcome.solver)


def _deformed_caption(outcome: Outcome, fields: Fields) -> str:
    scale = automatic_scale(fields)
    caption = (
        f"{clean(outcome.case)}: the largest verified case, as answered by "
        f"{clean(outcome.solver, 40)} at tol {tolerance(outcome.tol)} (run "
        f"{clean(outcome.run_ids[0], 40)}). Displacements are drawn "
        f"{'to scale ' if scale == SCALE else ''}(factor {scale:g})."
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
