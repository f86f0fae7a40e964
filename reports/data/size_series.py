"""Series of cases that differ only in size, and growth of time and iterations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.document.formatting import clean, tolerance
from mortarbench.reports.statistics.intervals import PowerLaw, power_law

SIZES = 3  #: minimum number of different sizes in a series

Sized = tuple[int, Outcome]


@dataclass(frozen=True, eq=False, kw_only=True)
class SizeSeries:
    """Cases that differ only in size, with the verified answers to each case."""

    title: str  #: family, fixed parameters, form, tolerance
    solvers: tuple[str, ...]
    #: number of dofs n, number of constraint rows m, and outcomes by solver
    sizes: tuple[tuple[int, int | None, dict[str, Outcome]], ...]

    @property
    def answers(self) -> int:
        """Number of verified answers in the series."""
        return sum(len(row) for _, _, row in self.sizes)

    def curve(self, solver: str, against: str = "n") -> list[Sized]:
        """Return ascending sizes n or m with the verified answers of one solver."""
        return [
            (size, row[solver])
            for n, m, row in self.sizes
            if solver in row and (size := n if against == "n" else m) is not None
        ]

    def time_law(self, solver: str, against: str = "n") -> PowerLaw | None:
        """Fit c·nᵖ or c·mᵖ to median total times; None for fewer than three sizes."""
        timed = ((s, o.seconds("total")) for s, o in self.curve(solver, against))
        return _law((s, t and t.value) for s, t in timed)

    def iteration_law(self, solver: str, against: str = "n") -> PowerLaw | None:
        """Fit c·nᵖ or c·mᵖ to iterations; return None for fewer than three sizes.

        If the repeats differ, the midpoint of their range is fitted.
        """
        counted = ((s, o.iterations) for s, o in self.curve(solver, against))
        return _law((s, i and sum(i) / 2) for s, i in counted)

    def counts(self, solver: str) -> tuple[str, ...]:
        """Return the names of the counts that a solver reports for every size."""
        named = [list(o.first.counts) for _, o in self.curve(solver)]
        return tuple(c for c in named[0] if all(c in n for n in named)) if named else ()

    def count_law(self, solver: str, name: str) -> PowerLaw | None:
        """Fit c·nᵖ to the means of one count; None for fewer than three sizes."""
        return _law((n, o.counted(name)) for n, o in self.curve(solver))


def _law(points: Iterable[tuple[int, float | None]]) -> PowerLaw | None:
    """Fit a power law to positive values; return None for fewer than `SIZES` sizes."""
    positive = [(n, v) for n, v in points if n > 0 and v is not None and v > 0]
    if len({n for n, _ in positive}) < SIZES:
        return None
    return power_law(*zip(*positive, strict=True))


class SeriesKey(NamedTuple):
    """Attributes that the cases of one series of sizes share."""

    family: str
    fixed: tuple[tuple[str, Any], ...]  #: names and values of the fixed parameters
    form: str
    tol: float
    solver: str  #: empty if the series includes the answers of all solvers

    @property
    def title(self) -> str:
        """Family, fixed parameters, form, solver and tolerance in one line."""
        keys = [f"{k}={v}" for k, v in self.fixed if v is not None]
        name = clean(
            "/".join([self.family, *keys, *([self.form] if self.form else [])])
        )
        named = [clean(self.solver, 40)] if self.solver else []
        return ", ".join([name, *named, f"tol {tolerance(self.tol)}"])


def sized(evidence: Evidence) -> list[Sized]:
    """Return (number of dofs, outcome) of verified answers whose dofs are known."""
    return [(n, o) for o in evidence.flat if o.verified and (n := o.size("dofs"))]


def by_series(
    answers: Iterable[Sized], solver: Callable[[Outcome], str] = lambda o: ""
) -> dict[SeriesKey, list[Sized]]:
    """Group answers to cases that differ only in size.

    A parameter is fixed within a series if cases of equal size differ in it (the load
    step, for example); the other parameters determine the size.
    """
    answers = list(answers)
    fixed = fixed_keys(answers)
    groups: dict[SeriesKey, list[Sized]] = {}
    for n, o in answers:
        r = o.first
        shared = tuple((k, r.params.get(k)) for k in fixed.get(r.family, ()))
        series = SeriesKey(r.family, shared, r.form, o.tol, solver(o))
        groups.setdefault(series, []).append((n, o))
    return groups


def fixed_keys(
    answers: Iterable[Sized], apart: Sequence[str] = ()
) -> dict[str, dict[str, None]]:
    """Return, by family, the parameters in which cases of equal size differ.

    Each inner dict serves as an ordered set; its values are None. A parameter that only
    some cases have differs from None.

    apart : parameters that are never fixed
    """
    answers = list(answers)
    keys: dict[str, dict[str, None]] = {}
    for _, o in answers:
        keys.setdefault(o.first.family, {}).update(dict.fromkeys(o.first.params))
    seen: dict[tuple[str, str, int], set[Any]] = {}
    for n, o in answers:
        for key in keys[o.first.family]:
            if key not in apart:
                value = o.first.params.get(key)
                seen.setdefault((o.first.family, key, n), set()).add(value)
    fixed: dict[str, dict[str, None]] = {}
    for (family, key, _), values in seen.items():
        if len(values) > 1:
            fixed.setdefault(family, {})[key] = None
    return fixed


def size_series(evidence: Evidence) -> list[SizeSeries]:
    """Return all series with at least three sizes.

    Size n is the number of dofs, and m is the number of equality and contact rows.
    """
    series = []
    for key, of in by_series(sized(evidence)).items():
        sizes: dict[int, dict[str, Outcome]] = {}
        for n, o in of:
            sizes.setdefault(n, {})[o.solver] = o
        present = {o.solver for _, o in of}
        rows = [
            (n, next(iter(row.values())).size("equality_rows", "contact_rows"), row)
            for n, row in sorted(sizes.items())
        ]
        if len(sizes) >= SIZES:
            solvers = tuple(s for s in evidence.solvers if s in present)
            series.append(
                SizeSeries(title=key.title, solvers=solvers, sizes=tuple(rows))
            )
    return series


@dataclass(frozen=True, eq=False, kw_only=True)
class Sweep:
    """Verified answers of one solver to cases that differ only in one parameter."""

    title: str  #: family, other parameters, form, tolerance
    solver: str
    answers: tuple[Sized, ...]  #: values of the parameter, ascending, with the answers


def sweeps(evidence: Evidence, key: str) -> list[Sweep]:
    """Return the sweeps of parameter `key` over at least three positive integers."""
    groups: dict[tuple[Any, ...], dict[int, Outcome]] = {}
    for o in evidence.flat:
        params = dict(o.first.params)
        value = params.pop(key, 0)
        if o.verified and isinstance(value, int) and value > 0:
            parts = o.first.case.split("/")
            case = "/".join(p for p in parts if not p.startswith(f"{key}="))
            same = (case, tuple(sorted(params.items())), o.tol, o.solver)
            groups.setdefault(same, {})[value] = o
    return [
        Sweep(
            title=f"{clean(case)}, tol {tolerance(tol)}",
            solver=solver,
            answers=tuple(sorted(answers.items())),
        )
        for (case, _, tol, solver), answers in groups.items()
        if len(answers) >= SIZES
    ]
