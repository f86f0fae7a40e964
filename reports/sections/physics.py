"""Physical results of verified answers: energies, quantities, deformed bodies."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence

from mortarbench.harness import InputError
from mortarbench.harness.files.store import load_fields
from mortarbench.reports.data.cells import source
from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.data.quantities import (
    best_of,
    elastic,
    head,
    leaves,
    quantity,
    spreads,
    unit,
)
from mortarbench.reports.document.formatting import clean, power, significant, tolerance
from mortarbench.reports.document.grouping import grouped
from mortarbench.reports.document.layout import Cell, Part, Picture, Table
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.figures.deformed import (
    PERCENTILE,
    SCALE,
    automatic_scale,
    clipped_at,
    deformed_figure,
    prefixed,
)
from mortarbench.reports.figures.maps import traction_maps
from mortarbench.reports.figures.tractions import traction_figure
from mortarbench.reports.sections import Analysis, section

TEXT = Sentences(__name__, PERCENTILE=PERCENTILE, SCALE=SCALE)


@section(
    58,
    "energies",
    "Agreement of energies",
    "Agreement of energies: no verified answer has an energy.",
)
def agreement(a: Analysis) -> Iterator[Part]:
    """Compare energies of verified answers; yield nothing if no case has an energy."""
    found = spreads(a.evidence.flat)
    if not found:
        return
    compared = [s for s in found if s.relative is not None]
    yield from TEXT.parts(
        "energies", max(compared, key=lambda s: s.relative or 0.0, default=None)
    )
    yield Table.of(
        TEXT("energies_caption"),
        found,
        (
            ("physical case", lambda s: Cell.name(s.answers[0].physical)),
            ("tol", lambda s: Cell.tolerance(s.answers[0].tol)),
            (
                "answers",
                lambda s: Cell.number(len(s.answers), title=source(*s.answers)),
            ),
            (
                "energy",
                lambda s: Cell(
                    text=significant(s.best.energy, s.digits),
                    after=unit(s.best, "energy"),
                    value=s.best.energy,
                    title=source(s.best),
                ),
            ),
            (
                "largest relative difference",
                lambda s: Cell.power(s.relative, title=source(*(s.pair or ()))),
            ),
            (
                "between",
                lambda s: Cell.words(
                    " and ".join(map(_solver_and_form, s.pair or ())) or "single answer"
                ),
            ),
        ),
    )


def _solver_and_form(outcome: Outcome) -> str:
    form = outcome.first.form
    return clean(f"{outcome.solver} on {form}" if form else outcome.solver, 60)


@section(
    80,
    "physics",
    "Physical results",
    "Physical results: no verified answer has physical quantities.",
)
def physics(a: Analysis) -> Iterator[Part]:
    """Tabulate sizes and physical results of one verified answer per physical case."""
    answered = [o for o in a.evidence.flat if o.verified and o.quantities]
    cases = grouped(answered, lambda o: o.physical).values()
    chosen = [(best_of(answers), answers) for answers in cases]
    if chosen:
        yield from TEXT.parts("physics", any(elastic(best) for best, _ in chosen))
    for family, mine in grouped(chosen, lambda each: each[0].first.family).items():
        yield from _quantities(mine, family, sizes=True)
        yield from _quantities(mine, family, sizes=False)


def _quantities(
    chosen: Sequence[tuple[Outcome, list[Outcome]]], family: str, *, sizes: bool
) -> Iterator[Table]:
    outcomes = [best for best, _ in chosen]
    paths = dict.fromkeys(path for o in outcomes for path in leaves(o, sizes=sizes))
    if not paths:
        return
    rows = []
    for best, answers in chosen:
        own = leaves(best, sizes=sizes)
        peers = [leaves(o, sizes=sizes) for o in answers if o.tol == best.tol]
        cells = [quantity(path, best, own.get(path), peers) for path in paths]
        accuracy = f"{power(best.worst)} at tol {tolerance(best.tol)}"
        answer = [
            Cell.words(f"{_solver_and_form(best)}, {accuracy}", title=source(best))
        ] * (not sizes)
        rows.append((Cell.name(best.physical), *cells, *answer))
    heads = (head(path, outcomes) for path in paths)
    yield Table(
        caption=TEXT(
            "quantities", "Sizes" if sizes else "Physical results", family, len(rows)
        ),
        notes=tuple(TEXT.parts("caveats", {path[0] for path in paths})),
        columns=("physical case", *heads, *["answer of"] * (not sizes)),
        rows=tuple(rows),
    )


@section(
    82,
    "deformed",
    "Deformed bodies",
    "Deformed bodies: no verified answer has bodies to draw.",
)
def deformed(a: Analysis) -> Iterator[Part]:
    """Draw the largest verified 2D and 3D cases, if there are any."""
    directory = a.evidence.directory
    largest = [
        max(mine, key=_importance)
        for mine in grouped(_drawable(a), lambda o: o.first.family).values()
    ]
    drawn: set[int] = set()  # dimensions (2 or 3) that are drawn already
    for chosen in sorted(largest, key=_importance, reverse=True):
        try:
            fields = load_fields(directory, chosen.first.fields or "")
            # rigid half planes alone have no cells
            if not len(fields.cells) or fields.dim in drawn:
                continue
            figure = deformed_figure(fields)
        except InputError as e:  # the journal may exist without vectors/
            missing = str(e).removeprefix(f"{directory}{os.sep}")
            yield TEXT("missing", chosen.case, missing)
            return
        scale, limits = automatic_scale(fields), clipped_at(fields)
        unit = prefixed(limits[0]) if limits else None
        caption = TEXT("deformed", chosen, fields.dim, scale, limits, unit)
        name = "deformed-in-space" if fields.dim == 3 and drawn else "deformed"
        yield Picture(name=name, caption=caption, figure=figure)
        drawn.add(fields.dim)


@section(
    84,
    "tractions",
    "Tractions along the contact",
    "Tractions along the contact: no verified answer has a contact side.",
)
def tractions(a: Analysis) -> Iterator[Part]:
    """Draw the tractions of the largest case of each family and friction law."""
    laws = grouped(_drawable(a), lambda o: (o.first.family, o.first.params.get("law")))
    for (family, law), mine in laws.items():
        chosen = max(reversed(mine), key=_importance)
        name = f"tractions-{family}" + f"-{law}" * (law is not None)
        try:
            fields = load_fields(a.evidence.directory, chosen.first.fields or "")
        except InputError:  # the section `deformed` reports that vectors/ is missing
            continue
        if (maps := traction_maps(fields)) is not None:
            rough = fields.contacts[0].friction is not None
            caption = TEXT("maps", chosen, rough, fields.contacts[0].exact is not None)
            yield Picture(name=name, caption=caption, figure=maps)
        elif (figure := traction_figure(fields)) is not None:
            rough = any(side.friction is not None for side in fields.contacts)
            exact = any(side.exact is not None for side in fields.contacts)
            caption = TEXT("tractions", chosen, rough, exact)
            yield Picture(name=name, caption=caption, figure=figure)


def _drawable(a: Analysis) -> list[Outcome]:
    """Return the verified answers whose deformed state is stored."""
    return [o for o in a.evidence.flat if o.verified and o.first.fields]


def _importance(outcome: Outcome) -> tuple[float, float, float, str, str]:
    """Return a sort key: size, then load step, then accuracy; names break ties."""
    step = outcome.first.params.get("step", 0)
    size = outcome.size("dofs") or outcome.size("contact_rows") or 0
    last = float(step) if isinstance(step, int | float) else 0.0
    return (size, last, -outcome.tol, outcome.first.form, outcome.solver)
