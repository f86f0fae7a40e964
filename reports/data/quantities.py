"""Physical quantities of answers: agreement between solvers, and significant digits."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from operator import itemgetter
from typing import Any, NamedTuple

from mortarbench.harness.record import in_space
from mortarbench.reports.data.cells import source
from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.document.formatting import clean, significant, span
from mortarbench.reports.document.layout import Cell

SIZES = ("nodes", "elements", "dofs", "equality_rows", "contact_rows")
#: key of the contact pairs, and the scalar that tables show for each pair
_CONTACTS, _PRESSURE = "contacts", "largest_pressure"
_UNITS = {
    "energy": "J/m",
    "tip": "m",
    "contact_force": "N/m",
    "multiplier_sum": "N/m",
    "max_von_mises": "Pa",
    "p_max": "Pa",
    "half_width": "m",
    "corner": "m",
    "contact_radius": "m",
    "approach": "m",
    _CONTACTS: "Pa",  # tables show the largest pressure of each pair
}
_STRESS = "max_von_mises"  #: quantity that only elastic bodies have
#: largest number of printed digits; few for stresses, which depend strongly on the mesh
MOST_DIGITS = {"energy": 12, _STRESS: 3}
_MOST = 7  #: largest number of printed digits of other quantities
_COMPONENTS = "xyz"


class Leaf(NamedTuple):
    """One scalar of the quantities."""

    value: Any
    scale: float  #: absolute value; for components, the largest in the vector


Leaves = dict[tuple[str, ...], Leaf]  #: scalars by path


def elastic(outcome: Outcome) -> bool:
    """Return True if the bodies are elastic; all quantities are then in SI units."""
    return _STRESS in outcome.quantities


def unit(outcome: Outcome, name: str) -> str:
    """Return the unit of a quantity; empty for a plain number or an unknown unit."""
    plane = _UNITS.get(name, "") if elastic(outcome) else ""
    return plane.removesuffix("/m") if in_space(outcome.quantities) else plane


def known_digits(doubt: float, most: int) -> int:
    """Return the number of digits on which answers agree, plus one; at most `most`.

    doubt : relative difference of the answers
    """
    if doubt <= 0 or not math.isfinite(doubt):
        return most
    return min(max(math.floor(-math.log10(doubt)) + 1, 1), most)


def leaves(outcome: Outcome, *, sizes: bool) -> Leaves:
    """Return the scalars of the quantities by path, with vectors as components.

    A list of more than three values is replaced by a text with their number.

    sizes : True for the quantities in `SIZES`, False for all others
    """
    scalars: Leaves = {}
    for name, value in outcome.quantities.items():
        if (name in SIZES) is sizes:
            scalars |= _flat((str(name),), value)
    # tables show one scalar of each contact pair, to limit their width
    return {
        path: leaf
        for path, leaf in scalars.items()
        if path[0] != _CONTACTS or len(path) == 1 or path[-1] == _PRESSURE
    }


def _flat(path: tuple[str, ...], value: object) -> dict[tuple[str, ...], Leaf]:
    match value:
        case Mapping():
            parts = [_flat((*path, str(k)), v) for k, v in value.items()]
            return {k: leaf for part in parts for k, leaf in part.items()}
        case list() | tuple() if len(value) > len(_COMPONENTS):
            return {path: Leaf(f"{len(value)} values", 0.0)}
        case list() | tuple():
            numbers = [abs(v) for v in value if isinstance(v, int | float)]
            scale = float(max(numbers, default=0.0))
            named = zip(_COMPONENTS, value, strict=False)
            return {(*path, axis): Leaf(v, scale) for axis, v in named}
        case _:
            number = isinstance(value, int | float)
            return {path: Leaf(value, abs(float(value)) if number else 0.0)}  # type: ignore[arg-type]


def head(path: tuple[str, ...], outcomes: Sequence[Outcome]) -> str:
    """Return the heading of a column, with the unit if all rows share it."""
    words = clean(" ".join(path).replace("_", " "), 40).replace("mises", "Mises")
    units = {unit(o, path[0]) for o in outcomes}
    (only,) = units if len(units) == 1 else ("",)
    return f"{words} in {only}" if only else words


def quantity(
    path: tuple[str, ...], best: Outcome, leaf: Leaf | None, peers: Sequence[Leaves]
) -> Cell:
    """Return a cell of the best answer, with one more digit than its peers agree on.

    leaf : scalar of the best answer, if it has one at `path`
    peers : leaves of all verified answers at the tolerance of the best answer
    """
    if leaf is None or leaf.value is None or isinstance(leaf.value, bool):
        return Cell()
    if not isinstance(leaf.value, int | float):
        return Cell(text=clean(str(leaf.value), 40), kind="words")
    values = [
        o.value
        for found in peers
        if (o := found.get(path)) and isinstance(o.value, int | float)
        if o.value == o.value
    ] or [leaf.value]
    if isinstance(leaf.value, int):
        text = span((int(min(values)), int(max(values))))
    else:
        differs = (max(values) - min(values)) / leaf.scale if leaf.scale else 0.0
        doubt = differs if len(values) > 1 else best.tol
        text = _rounded(leaf, known_digits(doubt, MOST_DIGITS.get(path[0], _MOST)))
    return Cell(text=text, value=leaf.value, title=source(best))


def _rounded(leaf: Leaf, digits: int) -> str:
    """Round a number to the last decimal place of its vector's largest component."""
    if not leaf.value or not math.isfinite(leaf.value):
        return significant(leaf.value)
    below = math.floor(math.log10(leaf.scale)) - math.floor(math.log10(abs(leaf.value)))
    return significant(leaf.value, digits - below) if below < digits else "0"


class Spread(NamedTuple):
    """Energies of the verified answers to one physical case, and their differences."""

    answers: tuple[Outcome, ...]  #: answers of every solver and form; at least one
    #: largest |E − E'|/max(|E|, |E'|) over pairs of energies; None for a single answer
    relative: float | None
    pair: tuple[Outcome, Outcome] | None  #: the two answers that differ most

    @property
    def best(self) -> Outcome:
        """Answer whose largest residual is smallest."""
        return best_of(self.answers)

    @property
    def digits(self) -> int:
        """Number of digits of the printed energy.

        The number follows from the difference of the answers; for a single answer, it
        follows from the tolerance.
        """
        doubt = self.answers[0].tol if self.relative is None else self.relative
        return known_digits(doubt, MOST_DIGITS["energy"])


def spreads(outcomes: Iterable[Outcome]) -> list[Spread]:
    """Compare energies pairwise for each physical case and tolerance.

    Answers are compared across solvers and across primal and dual forms; no answer
    serves as the reference.
    """
    groups: dict[tuple[str, float], list[Outcome]] = {}
    for o in outcomes:
        if o.verified and o.energy is not None:
            groups.setdefault((o.physical, o.tol), []).append(o)
    result = []
    for group in groups.values():
        apart = ((_difference(*pair), pair) for pair in combinations(group, 2))
        widest = max(apart, key=itemgetter(0), default=(None, None))
        result.append(Spread(tuple(group), *widest))
    return result


def _difference(a: Outcome, b: Outcome) -> float:
    e, f = a.energy or 0.0, b.energy or 0.0
    return abs(e - f) / max(abs(e), abs(f)) if e != f else 0.0


def best_of(answers: Sequence[Outcome]) -> Outcome:
    """Return the answer whose largest residual is smallest; names break ties."""
    return min(
        answers,
        key=lambda o: (math.inf if o.worst is None else o.worst, o.case, o.solver),
    )
