"""Time and iterations against size, with fitted exponents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from reports.data import Evidence, Outcome
from reports.intervals import PowerLaw, power_law
from reports.layout import Cell, Section, Table, source
from reports.wording import ABSENT, TIMED, clean, exponent, seconds, span, tolerance

#: What the sizes of a ladder count, wherever they are shown.
SIZES_NAMED = (
    "n: displacement components (degrees of freedom); m: dual size, the rows of "
    "equality and contact constraints."
)
SIZES = 3  #: fewer different sizes make no table


@dataclass(frozen=True, eq=False, kw_only=True)
class Ladder:
    """Cases that differ in size only, and the verified answers on each."""

    title: str  #: family, the parameters held, form, tolerance
    solvers: tuple[str, ...]
    rungs: tuple[tuple[int, int | None, dict[str, Outcome]], ...]  #: n, m, by solver

    @property
    def answers(self) -> int:
        """How many verified answers it rests on."""
        return sum(len(row) for _, _, row in self.rungs)

    def curve(self, solver: str) -> list[tuple[int, Outcome]]:
        """Sizes n and verified answers of one solver, smallest first."""
        return [(n, row[solver]) for n, _, row in self.rungs if solver in row]

    def time_law(self, solver: str, against: str = "n") -> PowerLaw | None:
        """Fit median total time ~ nᵖ or mᵖ; None with fewer than three sizes."""
        timed = [(s, o.seconds("total")) for s, o in self._sized(solver, against)]
        return _law([(s, t.value) for s, t in timed if t is not None])

    def iteration_law(self, solver: str, against: str = "n") -> PowerLaw | None:
        """Fit iterations ~ nᵖ or mᵖ, repeats averaged; None below three sizes."""
        counted = [(s, o.iterations) for s, o in self._sized(solver, against)]
        return _law([(s, sum(i) / 2) for s, i in counted if i is not None])

    def _sized(self, solver: str, against: str) -> list[tuple[int, Outcome]]:
        """Sizes n or m and the answers of one solver; those without are left out."""
        return [
            (size, row[solver])
            for n, m, row in self.rungs
            if solver in row and (size := n if against == "n" else m) is not None
        ]


def _law(points: list[tuple[int, float]]) -> PowerLaw | None:
    kept = [(n, v) for n, v in points if n > 0 and v > 0]
    if len({n for n, _ in kept}) < SIZES:
        return None
    return power_law(*zip(*kept, strict=True))


def ladders(evidence: Evidence) -> list[Ladder]:
    """Find the cases that form a ladder of at least three sizes.

    n is the number of dofs, m the rows of equalities and contact. A key of the case
    name is held fixed within a ladder if cases of equal n differ in it (the load step,
    say); the others are what makes a case larger.
    """
    sized = [(o, n) for o in evidence.flat if o.verified and (n := o.size("dofs"))]
    held = _held(sized)
    groups: dict[tuple[Any, ...], dict[int, dict[str, Outcome]]] = {}
    for o, n in sized:
        kept = tuple((k, o.first.params.get(k)) for k in held[o.first.family])
        key = (o.first.family, kept, o.first.form, o.tol)
        groups.setdefault(key, {}).setdefault(n, {})[o.solver] = o
    return [
        _ladder(key, rungs, evidence.solvers)
        for key, rungs in groups.items()
        if len(rungs) >= SIZES
    ]


def _held(sized: Sequence[tuple[Outcome, int]]) -> dict[str, tuple[str, ...]]:
    """Name, per family, the keys in which cases of equal size differ."""
    seen: dict[tuple[str, int, str], set[Any]] = {}
    for o, n in sized:
        for key, value in o.first.params.items():
            seen.setdefault((o.first.family, n, key), set()).add(value)
    held: dict[str, dict[str, None]] = {o.first.family: {} for o, _ in sized}
    for (family, _, key), values in seen.items():
        if len(values) > 1:
            held[family][key] = None
    return {family: tuple(keys) for family, keys in held.items()}


def _ladder(
    key: tuple[Any, ...],
    rungs: dict[int, dict[str, Outcome]],
    solvers: tuple[str, ...],
) -> Ladder:
    family, kept, form, tol = key
    names = [family, *(f"{k}={v}" for k, v in kept), *([form] if form else [])]
    present = {s for row in rungs.values() for s in row}
    rows = []
    for n, row in sorted(rungs.items()):
        m = next(iter(row.values())).size("equality_rows", "contact_rows")
        rows.append((n, m, row))
    return Ladder(
        title=f"{clean('/'.join(names))}, tol {tolerance(tol)}",
        solvers=tuple(s for s in solvers if s in present),
        rungs=tuple(rows),
    )


def scaling(found: Sequence[Ladder]) -> Section | None:
    """Tabulate every ladder; None where there is none."""
    if not found:
        return None
    return Section(
        name="scaling",
        title="Scaling",
        prose=(
            "Verified answers only. The exponents p of t = c·nᵖ and of t = c·mᵖ are "
            "fitted by least squares on logarithms, one point (the median of the "
            "repeats) per size; the 95 % interval is Student's with two degrees of "
            "freedom fewer than sizes, exact if the logarithms scatter normally about "
            "the line. It is a statement about the sizes in the table, not beyond "
            "them. Where m grows more slowly than n, as it does for contact on a "
            "boundary, the exponent against m is the larger for the same times.",
        ),
        tables=tuple(t for ladder in found for t in _tables(ladder)),
    )


def _tables(ladder: Ladder) -> tuple[Table, Table]:
    heads = ("n", "m", *(clean(s, 40) for s in ladder.solvers))
    times, counts = [], []
    for n, m, row in ladder.rungs:
        size = (Cell(text=str(n), value=n), Cell(text=_rows(m), value=m))
        present = [row.get(s) for s in ladder.solvers]
        times.append((*size, *map(_time, present)))
        counts.append((*size, *map(_iterations, present)))
    for against in ("n", "m"):
        head = f"p against {against} [95 %]"
        label = (Cell(text=head, kind="total"), Cell(text="", kind="total"))
        laws = [ladder.time_law(s, against) for s in ladder.solvers]
        growth = [ladder.iteration_law(s, against) for s in ladder.solvers]
        from_runs = [source(*(o for _, o in ladder.curve(s))) for s in ladder.solvers]
        times.append((*label, *map(_exponent, laws, from_runs)))
        counts.append((*label, *map(_exponent, growth, from_runs)))
    return (
        Table(
            caption=f"Total time against size: {ladder.title}.",
            notes=(SIZES_NAMED, TIMED),
            columns=heads,
            rows=tuple(times),
            text_columns=0,
        ),
        Table(
            caption=f"Iterations against size: {ladder.title}.",
            notes=(SIZES_NAMED,),
            columns=heads,
            rows=tuple(counts),
            text_columns=0,
        ),
    )


def _rows(m: int | None) -> str:
    return ABSENT if m is None else str(m)


def _time(outcome: Outcome | None) -> Cell:
    if outcome is None:
        return Cell(text="not verified", kind="quiet")
    interval = outcome.seconds("total")
    return Cell(
        text=seconds(interval),
        title=source(outcome),
        value=interval.value if interval else None,
    )


def _iterations(outcome: Outcome | None) -> Cell:
    if outcome is None:
        return Cell(text="not verified", kind="quiet")
    its = outcome.iterations
    return Cell(text=span(its), title=source(outcome), value=its[0] if its else None)


def _exponent(law: PowerLaw | None, runs: str) -> Cell:
    if law is None:
        return Cell(text=ABSENT, kind="total", title="fewer than three verified sizes")
    return Cell(text=exponent(law), kind="total", value=law.exponent, title=runs)
