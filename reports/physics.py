"""Energies set against each other, and the physical results of verified answers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import NamedTuple

from reports.data import Evidence, Outcome, energies
from reports.layout import Cell, Section, Table, name_cell, source
from reports.summary import flatten
from reports.wording import clean, plural, power, significant, tolerance

_SIZES = ("nodes", "elements", "dofs", "equality_rows", "contact_rows")
_UNITS = {
    "energy": "J/m",
    "tip": "m",
    "contact_force": "N/m",
    "multiplier_sum": "N/m",
    "max_von_mises": "Pa",
}


class Spread(NamedTuple):
    """How far the energies of verified answers to one physical case lie apart."""

    answers: tuple[Outcome, ...]  #: of every solver and form; at least one
    relative: float | None  #: largest pairwise |E − E'|/max(|E|, |E'|); None if alone
    pair: tuple[Outcome, Outcome] | None  #: where it occurs

    @property
    def best(self) -> Outcome:
        """The answer with the smallest worst residual."""
        return min(self.answers, key=lambda o: (_residual(o), o.case, o.solver))


def spreads(outcomes: Iterable[Outcome]) -> list[Spread]:
    """Compare energies pairwise per physical case and tolerance.

    No answer serves as the reference of the others: each is set against each, across
    solvers and across primal and dual forms.
    """
    groups: dict[tuple[str, float], list[Outcome]] = {}
    for o in energies(tuple(outcomes)):
        groups.setdefault((o.physical, o.tol), []).append(o)
    return [_spread(tuple(group)) for group in groups.values()]


def _spread(answers: tuple[Outcome, ...]) -> Spread:
    pairs = list(combinations(answers, 2))
    if not pairs:
        return Spread(answers, None, None)
    differences = [_difference(a, b) for a, b in pairs]
    worst = max(range(len(pairs)), key=differences.__getitem__)
    return Spread(answers, differences[worst], pairs[worst])


def _difference(a: Outcome, b: Outcome) -> float:
    e, f = a.energy or 0.0, b.energy or 0.0
    return abs(e - f) / max(abs(e), abs(f)) if e != f else 0.0


def _residual(outcome: Outcome) -> float:
    return float("inf") if outcome.worst is None else outcome.worst


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
                "residuals.",
                columns=(
                    "physical case", "tol", "answers", "energy in J/m",
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
        Cell(text=str(len(s.answers)), value=len(s.answers)),
        Cell(
            text=significant(s.best.energy, 12),
            value=s.best.energy,
            title=source(s.best),
        ),
        Cell(text=power(s.relative), value=s.relative),
        Cell(text=between, kind="words"),
    )


def _who(outcome: Outcome) -> str:
    form = outcome.first.form
    return clean(f"{outcome.solver} on {form}" if form else outcome.solver, 60)


def physics(evidence: Evidence) -> Section | None:
    """Show sizes and physical results, one verified answer per physical case."""
    chosen = _best_per_case([o for o in evidence.flat if o.verified and o.quantities])
    if not chosen:
        return None
    tables = []
    for family in dict.fromkeys(o.first.family for o in chosen):
        mine = [o for o in chosen if o.first.family == family]
        tables += [
            _quantities(mine, family, sizes=True),
            _quantities(mine, family, sizes=False),
        ]
    return Section(
        name="physics",
        title="Physical results",
        prose=(
            "One answer per physical case, of all verified ones at the tightest "
            "tolerance that with the smallest residuals. SI units.",
        ),
        tables=tuple(t for t in tables if t is not None),
    )


def _best_per_case(outcomes: Sequence[Outcome]) -> list[Outcome]:
    best: dict[str, Outcome] = {}
    for o in outcomes:
        held = best.get(o.physical)
        if held is None or (o.tol, _residual(o)) < (held.tol, _residual(held)):
            best[o.physical] = o
    return list(best.values())


def _quantities(
    outcomes: Sequence[Outcome], family: str, *, sizes: bool
) -> Table | None:
    rows = [dict(_leaves(o, sizes=sizes)) for o in outcomes]
    names = list(dict.fromkeys(name for row in rows for name in row))
    if not names:
        return None
    cells = [
        (
            name_cell(o.physical),
            *(_quantity(row.get(name), o) for name in names),
            Cell(text=_who(o), kind="words", title=source(o)),
        )
        for o, row in zip(outcomes, rows, strict=True)
    ]
    what = "Sizes" if sizes else "Physical results"
    heads = tuple(clean(name.replace("_", " "), 40) for name in names)
    return Table(
        caption=f"{what} of {clean(family, 40)}: {plural(len(cells), 'case')}.",
        columns=("physical case", *heads, "answer of"),
        rows=tuple(cells),
    )


def _leaves(outcome: Outcome, *, sizes: bool) -> list[tuple[str, object]]:
    """Name every scalar, with its unit, vectors by component."""
    found: list[tuple[str, object]] = []
    for name, value in outcome.quantities.items():
        if (name in _SIZES) is not sizes:
            continue
        unit = f" in {_UNITS[name]}" if name in _UNITS else ""
        if isinstance(value, list | tuple):
            axes = "xyz" if len(value) <= 3 else range(len(value))
            pairs = zip(axes, value, strict=False)
            found += [(f"{name} {axis}{unit}", v) for axis, v in pairs]
        else:
            leaves = flatten(value, name)
            found += [(f"{key.replace('.', ' ')}{unit}", v) for key, v in leaves]
    return found


def _quantity(value: object, outcome: Outcome) -> Cell:
    match value:
        case bool() | None:
            return Cell()
        case int():
            return Cell(text=str(value), value=value, title=source(outcome))
        case float():
            return Cell(text=significant(value, 7), value=value, title=source(outcome))
        case _:
            return Cell(text=clean(str(value), 40), kind="words")
