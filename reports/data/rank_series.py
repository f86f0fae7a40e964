"""Measured strong and weak scaling of one solve over the number of ranks.

Strong scaling solves one case on an increasing number of ranks. Weak scaling enlarges
the case in proportion to the number of ranks, so that the number of dofs per rank is
constant up to the factor 1 ± `ALIKE`. Both are reported separately for preparation and
solve.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import median
from typing import NamedTuple

from mortarbench.harness.running.pairs import paired_ratio, unpaired_ratio
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.data.size_series import by_series, sized
from mortarbench.reports.document.formatting import clean, tolerance
from mortarbench.reports.statistics.intervals import COVERAGE, Interval

PHASES = ("prepare", "solve")
ALIKE = 0.05  #: largest relative difference in dofs per rank within a weak series


@dataclass(frozen=True, eq=False, kw_only=True)
class _Scaling:
    """Verified answers of one solver for several numbers of ranks."""

    solver: str  #: label of the solver on one rank
    cpus: int | None  #: number of CPUs of the machine, if known

    def crowded(self, ranks: int) -> bool:
        """Return whether ranks outnumber CPUs, so that ranks shared CPUs."""
        return self.cpus is not None and ranks > self.cpus


@dataclass(frozen=True, eq=False, kw_only=True)
class StrongSeries(_Scaling):
    """Verified answers of one solver to one case on one rank and on several ranks."""

    case: str
    tol: float
    #: answers by number of ranks, ascending; the first is on one rank
    answers: Mapping[int, Outcome]

    @property
    def title(self) -> str:
        """Case, solver and tolerance."""
        solver, tol = clean(self.solver, 40), tolerance(self.tol)
        return f"{clean(self.case)}, {solver}, tol {tol}"

    @property
    def several(self) -> tuple[int, ...]:
        """Measured numbers of ranks greater than one."""
        return tuple(self.answers)[1:]

    def speed_up(self, ranks: int, phase: str) -> Interval | None:
        """Return the speed-up t(1)/t(N)."""
        return _ratio(self.answers[1], self.answers[ranks], phase)

    def efficiency(self, ranks: int, phase: str) -> Interval | None:
        """Return the efficiency t(1)/(N·t(N))."""
        return _ratio(self.answers[1], self.answers[ranks], phase, 1 / ranks)


class Member(NamedTuple):
    """One case of a weak series, with its number of ranks."""

    ranks: int
    dofs: int
    answer: Outcome

    def growth(self, first: Member) -> float:
        """Return the dofs per rank relative to the first case on one rank."""
        return self.dofs / (self.ranks * first.dofs)


@dataclass(frozen=True, eq=False, kw_only=True)
class WeakSeries(_Scaling):
    """Verified answers of one solver to cases with about equally many dofs per rank."""

    title: str  #: family, fixed parameters, solver, tolerance
    #: members by number of ranks, ascending; the first is on one rank
    members: tuple[Member, ...]

    def efficiency(self, member: Member, phase: str) -> Interval | None:
        """Return the efficiency t(1)/t(N) relative to the first case; ideally 1."""
        return _ratio(self.members[0].answer, member.answer, phase, paired=False)


def strong_series(evidence: Evidence) -> list[StrongSeries]:
    """Return a series for each case that a solver solved on one rank and on several."""
    series = []
    for (case, tol), row in evidence.outcomes.items():
        by_ranks: dict[str, dict[int, Outcome]] = {}
        for o in row.values():
            if o.verified and not o.first.arm:
                by_ranks.setdefault(base_label(o), {})[o.first.ranks] = o
        series += [
            StrongSeries(
                case=case,
                tol=tol,
                solver=solver,
                cpus=_cpus(evidence),
                answers=dict(sorted(answers.items())),
            )
            for solver, answers in by_ranks.items()
            if 1 in answers and len(answers) > 1
        ]
    return series


def weak_series(evidence: Evidence) -> list[WeakSeries]:
    """Return the series of cases with equally many dofs per rank, within 5 %.

    Parameters that do not determine the size are fixed, as in `size_series`.
    """
    series = []
    for key, of in by_series(sized(evidence), base_label).items():
        members = [Member(o.first.ranks, n, o) for n, o in of if not o.first.arm]
        alone = [m for m in members if m.ranks == 1]
        for first in sorted(alone, key=lambda m: m.dofs):
            by_ranks = {1: [first]}
            for m in sorted(members, key=lambda m: m.ranks):
                if m.ranks > 1 and abs(m.growth(first) - 1) <= ALIKE:
                    by_ranks.setdefault(m.ranks, []).append(m)
            if len(by_ranks) > 1:
                series.append(
                    WeakSeries(
                        title=key.title,
                        solver=key.solver,
                        members=tuple(
                            min(ms, key=lambda m: abs(m.growth(first) - 1))
                            for ms in by_ranks.values()
                        ),
                        cpus=_cpus(evidence),
                    )
                )
    return series


def base_label(o: Outcome) -> str:
    """Return the label that a solver has on one rank."""
    return o.solver.replace(f" ranks={o.first.ranks}", "", 1)


def _ratio(
    a: Outcome,
    b: Outcome,
    phase: str,
    factor: float = 1.0,
    *,
    paired: bool = True,
) -> Interval | None:
    """Return factor·t(a)/t(b); the interval of single runs has zero width.

    paired : True if the times of a and b in a block were measured in succession
    """
    of_a, of_b = a.seconds_by_block(phase), b.seconds_by_block(phase)
    if not of_a or not of_b:
        return None
    ratio = paired_ratio(of_a, of_b) if paired else None
    ratio = ratio or unpaired_ratio(of_a.values(), of_b.values())
    if ratio is None:
        value = factor * median(of_a.values()) / median(of_b.values())
        return Interval(value, value, value, 0.0, 1)
    value, low, high = (factor * v for v in ratio[:3])
    return Interval(value, low, high, COVERAGE, ratio.pairs)


def rank_memory(o: Outcome) -> float | None:
    """Return the largest peak memory of a rank, MiB; None if unknown.

    The value is the median over the repeats.
    """
    peaks = [r.reported.get("rank_peak_mib_largest") for r in o.records]
    numbers = [peak for peak in peaks if isinstance(peak, int | float)]
    return float(median(numbers)) if numbers else None


def _cpus(evidence: Evidence) -> int | None:
    machine = evidence.environment.get("machine", {})
    usable = machine.get("usable_cores") if isinstance(machine, Mapping) else None
    return usable if isinstance(usable, int) else None
