"""Cases that differ in size only, and how time and iterations grow along them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mortarbench.harness.registry import COPIES
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.document.formatting import clean, tolerance
from mortarbench.reports.statistics.intervals import PowerLaw, power_law

SIZES = 3  #: fewer different sizes make no table


@dataclass(frozen=True, eq=False, kw_only=True)
class SizeSeries:
    """Cases that differ in size only, and the verified answers on each."""

    title: str  #: family, the parameters held, form, tolerance
    solvers: tuple[str, ...]
    sizes: tuple[tuple[int, int | None, dict[str, Outcome]], ...]  #: n, m, by solver

    @property
    def answers(self) -> int:
        """How many verified answers it rests on."""
        return sum(len(row) for _, _, row in self.sizes)

    def curve(self, solver: str) -> list[tuple[int, Outcome]]:
        """Sizes n and verified answers of one solver, smallest first."""
        return [(n, row[solver]) for n, _, row in self.sizes if solver in row]

    def time_law(self, solver: str, against: str = "n") -> PowerLaw | None:
        """Fit median total time ~ nᵖ or mᵖ; None with fewer than three sizes."""
        timed = [(s, o.seconds("total")) for s, o in self._sized(solver, against)]
        return _law([(s, t.value) for s, t in timed if t is not None])

    def iteration_law(self, solver: str, against: str = "n") -> PowerLaw | None:
        """Fit iterations ~ nᵖ or mᵖ, repeats averaged; None below three sizes."""
        counted = [(s, o.iterations) for s, o in self._sized(solver, against)]
        return _law([(s, sum(i) / 2) for s, i in counted if i is not None])

    def counts(self, solver: str) -> tuple[str, ...]:
        """Name what one solver counts on every size that it is verified on."""
        named = [list(o.first.counts) for _, o in self.curve(solver)]
        return tuple(c for c in named[0] if all(c in n for n in named)) if named else ()

    def count_law(self, solver: str, name: str) -> PowerLaw | None:
        """Fit one count ~ nᵖ, repeats averaged; None below three sizes."""
        return _law([(n, o.counted(name) or 0.0) for n, o in self.curve(solver)])

    def _sized(self, solver: str, against: str) -> list[tuple[int, Outcome]]:
        """Sizes n or m and the answers of one solver; those without are left out."""
        return [
            (size, row[solver])
            for n, m, row in self.sizes
            if solver in row and (size := n if against == "n" else m) is not None
        ]


def _law(points: list[tuple[int, float]]) -> PowerLaw | None:
    kept = [(n, v) for n, v in points if n > 0 and v > 0]
    if len({n for n, _ in kept}) < SIZES:
        return None
    return power_law(*zip(*kept, strict=True))


def size_series(evidence: Evidence) -> list[SizeSeries]:
    """Find the cases that form a series of at least three sizes.

    n is the number of dofs, m the rows of equalities and contact. A key of the case
    name is held fixed within a series if cases of equal n differ in it (the load step,
    say); the others are what makes a case larger.
    """
    sized = [
        (o, n)
        for o in evidence.flat
        if o.verified and o.first.role != COPIES and (n := o.size("dofs"))
    ]
    held = held_keys(sized)
    groups: dict[tuple[Any, ...], dict[int, dict[str, Outcome]]] = {}
    for o, n in sized:
        kept = tuple((k, o.first.params.get(k)) for k in held[o.first.family])
        key = (o.first.family, kept, o.first.form, o.tol)
        groups.setdefault(key, {}).setdefault(n, {})[o.solver] = o
    return [
        _series(key, sizes, evidence.solvers)
        for key, sizes in groups.items()
        if len(sizes) >= SIZES
    ]


@dataclass(frozen=True, eq=False, kw_only=True)
class Sweep:
    """Cases that differ in one key only, and one solver's verified answers on each."""

    title: str  #: family, other parameters, form, tolerance
    solver: str
    answers: tuple[tuple[int, Outcome], ...]  #: by the value of the key


def sweeps(evidence: Evidence, key: str) -> list[Sweep]:
    """Find where one key alone takes at least three positive values."""
    groups: dict[tuple[Any, ...], dict[int, Outcome]] = {}
    for o in evidence.flat:
        params = dict(o.first.params)
        value = params.pop(key, 0)
        counts = o.verified and o.first.role != COPIES
        if counts and isinstance(value, int) and value > 0:
            case = "/".join(
                part
                for part in o.first.case.split("/")
                if not part.startswith(f"{key}=")
            )
            same = (case, tuple(sorted(params.items())), o.tol, o.solver)
            groups.setdefault(same, {})[value] = o
    return [
        Sweep(
            title=f"{clean(case)}, tol {tolerance(tol)}", solver=solver,
            answers=tuple(sorted(found.items())),
        )
        for (case, _, tol, solver), found in groups.items()
        if len(found) >= SIZES
    ]  # fmt: skip


def held_keys(sized: Sequence[tuple[Outcome, int]]) -> dict[str, tuple[str, ...]]:
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


def _series(
    key: tuple[Any, ...],
    sizes: dict[int, dict[str, Outcome]],
    solvers: tuple[str, ...],
) -> SizeSeries:
    family, kept, form, tol = key
    names = [family, *(f"{k}={v}" for k, v in kept), *([form] if form else [])]
    present = {s for row in sizes.values() for s in row}
    rows = []
    for n, row in sorted(sizes.items()):
        m = next(iter(row.values())).size("equality_rows", "contact_rows")
        rows.append((n, m, row))
    return SizeSeries(
        title=f"{clean('/'.join(names))}, tol {tolerance(tol)}",
        solvers=tuple(s for s in solvers if s in present),
        sizes=tuple(rows),
    )
