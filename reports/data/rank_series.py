"""One solve on several numbers of ranks: strong and weak scaling, as measured.

Strong scaling is one case on more ranks. Weak scaling is a case that grows with the
ranks, so that each has as much. Both are told of preparing and solving apart, and held
against copies: what so many independent solves reach that run at the same time on the
same machine, whose memory they share as ranks do.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from mortarbench.harness.registry import COPIES
from mortarbench.harness.running.pairs import Block, Ratio, paired_ratio, unpaired_ratio
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.data.size_series import held_keys
from mortarbench.reports.document.formatting import clean, tolerance
from mortarbench.reports.statistics.cost_model import (
    Communication,
    CostModel,
    cost_model,
)
from mortarbench.reports.statistics.intervals import COVERAGE, Interval

PHASES = ("prepare", "solve")
ALIKE = 0.05  #: dofs of a rank may differ by that much, relatively, in weak scaling


class Part(NamedTuple):
    """What ranks spent, sent or held: medians over the repeats."""

    mean: float  #: of the ranks
    largest: float


@dataclass(frozen=True, eq=False, kw_only=True)
class StrongSeries:
    """Verified answers of one solver to one case on one rank and on several."""

    case: str
    tol: float
    solver: str  #: its label on one rank
    answers: Mapping[int, Outcome]  #: by ranks, ascending; the first is one
    copies: Mapping[int, Outcome]  #: of so many independent solves at once
    cpus: int | None  #: that the machine has, if known

    @property
    def title(self) -> str:
        """Case, solver and tolerance."""
        solver, tol = clean(self.solver, 40), tolerance(self.tol)
        return f"{clean(self.case)}, {solver}, tol {tol}"

    @property
    def several(self) -> tuple[int, ...]:
        """The numbers of ranks above one."""
        return tuple(self.answers)[1:]

    def crowded(self, ranks: int) -> bool:
        """Whether ranks had to share CPUs: their times say nothing about others."""
        return self.cpus is not None and ranks > self.cpus

    def speed_up(self, ranks: int, phase: str) -> Interval | None:
        """Compare one rank with several: t(1)/t(N)."""
        return _ratio(self.answers[1], self.answers[ranks], phase)

    def efficiency(self, ranks: int, phase: str) -> Interval | None:
        """Give the part of N-fold speed that is reached: t(1)/(N·t(N))."""
        return _times(self.speed_up(ranks, phase), 1 / ranks)

    def reach(self, ranks: int, phase: str) -> Interval | None:
        """Give what copies reach together, in solves of one rank: N·t(1)/t(copies)."""
        if ranks not in self.copies:
            return None
        return _times(_ratio(self.answers[1], self.copies[ranks], phase), ranks)

    def against_copies(self, ranks: int, phase: str) -> Interval | None:
        """Give the part of the reach of copies: t(copies)/(N·t(N))."""
        if ranks not in self.copies:
            return None
        return _times(_ratio(self.copies[ranks], self.answers[ranks], phase), 1 / ranks)

    @cached_property
    def model(self) -> CostModel | None:
        """Model the solve; None where the records of ranks do not say what they sent.

        Ranks that shared CPUs are left out.
        """
        seconds = {
            n: [*blocks(o, "solve").values()]
            for n, o in self.answers.items()
            if not self.crowded(n)
        }
        free = [n for n, of in seconds.items() if of]
        if len(free) < 2 or free[0] != 1:
            return None
        sent = [_communication(r) for r in self.answers[free[-1]].records]
        known = [c for c in sent if c is not None]
        if not known:
            return None
        copies = {
            n: of
            for n in free
            if n in self.copies and (of := [*blocks(self.copies[n], "solve").values()])
        }
        return cost_model({n: seconds[n] for n in free}, copies, known)

    @property
    def most(self) -> int | None:
        """Count the subdomains, at most one rank for each; None if unknown."""
        return self.answers[1].size("subdomains")


class Member(NamedTuple):
    """One case of a weak series, on so many ranks."""

    ranks: int
    dofs: int
    answer: Outcome


@dataclass(frozen=True, eq=False, kw_only=True)
class WeakSeries:
    """Verified answers of one solver, each on ranks that have equally many dofs."""

    title: str  #: family, parameters held, solver, tolerance
    solver: str  #: its label on one rank
    members: tuple[Member, ...]  #: by ranks; the first is on one
    copies: Mapping[int, Outcome]  #: of the first case, so many at once
    cpus: int | None  #: that the machine has, if known

    def crowded(self, ranks: int) -> bool:
        """Whether ranks had to share CPUs."""
        return self.cpus is not None and ranks > self.cpus

    def efficiency(self, member: Member, phase: str) -> Interval | None:
        """Compare with the first case on one rank: t(1)/t(N), 1 at best."""
        return _ratio(self.members[0].answer, member.answer, phase, paired=False)

    def against_copies(self, member: Member, phase: str) -> Interval | None:
        """Compare with as many copies of the first case at once: t(copies)/t(N)."""
        if member.ranks not in self.copies:
            return None
        return _ratio(self.copies[member.ranks], member.answer, phase, paired=False)


def strong_series(evidence: Evidence) -> list[StrongSeries]:
    """Find the cases that a solver was verified on with one rank and with several."""
    found = []
    for (case, tol), row in evidence.outcomes.items():
        alone, copies = _by_ranks(row.values())
        found += [
            StrongSeries(
                case=case, tol=tol, solver=solver, cpus=_cpus(evidence),
                answers=dict(sorted(answers.items())), copies=copies.get(solver, {}),
            )
            for solver, answers in alone.items()
            if 1 in answers and len(answers) > 1
        ]  # fmt: skip
    return found


def weak_series(evidence: Evidence) -> list[WeakSeries]:
    """Find cases that grow with the ranks: equally many dofs for each, within 5 %.

    What else cases differ in is held, as in series of sizes (`size_series`).
    """
    groups: dict[tuple[Any, ...], list[Outcome]] = {}
    sized = [(o, n) for o in evidence.flat if o.verified and (n := o.size("dofs"))]
    held = held_keys(sized)
    for o, _ in sized:
        kept = tuple((k, o.first.params.get(k)) for k in held[o.first.family])
        key = (o.first.family, kept, o.first.form, base_label(o), o.tol)
        groups.setdefault(key, []).append(o)
    found = []
    for (family, kept, form, solver, tol), of in groups.items():
        keys = [f"{k}={v}" for k, v in kept]
        name = clean("/".join([family, *keys, *([form] * bool(form))]))
        title = f"{name}, {clean(solver, 40)}, tol {tolerance(tol)}"
        answers = [Member(o.first.ranks, n, o) for o, n in _sized(of, copies=False)]
        copied = [o for o, _ in _sized(of, copies=True)]
        alone = [m for m in answers if m.ranks == 1]
        for first in sorted(alone, key=lambda m: m.dofs):
            members = tuple(_grown(first, answers))
            if len(members) > 1:
                found.append(
                    WeakSeries(
                        title=title, solver=solver, members=members,
                        cpus=_cpus(evidence),
                        copies={
                            o.first.ranks: o
                            for o in copied
                            if o.case == first.answer.case
                        },
                    )
                )  # fmt: skip
    return found


def _sized(of: Iterable[Outcome], *, copies: bool) -> list[tuple[Outcome, int]]:
    chosen = (o for o in of if (o.first.role == COPIES) is copies)
    return [
        (o, n) for o in chosen if o.first.role in ("", COPIES) and (n := o.size("dofs"))
    ]


def _grown(first: Member, of: Iterable[Member]) -> Iterable[Member]:
    """Choose, for every number of ranks, the case that is nearest to so many times."""
    by_ranks: dict[int, list[Member]] = {1: [first]}
    for m in of:
        if m.ranks > 1 and abs(_growth(first, m) - 1) <= ALIKE:
            by_ranks.setdefault(m.ranks, []).append(m)
    for _, members in sorted(by_ranks.items()):
        yield min(members, key=lambda m: abs(_growth(first, m) - 1))


def _growth(first: Member, m: Member) -> float:
    return m.dofs / (m.ranks * first.dofs)


def base_label(o: Outcome) -> str:
    """Give the label that a solver has on one rank."""
    r = o.first
    word = "copies" if r.role == COPIES else "ranks"
    return o.solver.replace(f" {word}={r.ranks}", "", 1) if r.ranks > 1 else o.solver


def _by_ranks(
    row: Iterable[Outcome],
) -> tuple[dict[str, dict[int, Outcome]], dict[str, dict[int, Outcome]]]:
    """Group verified answers by solver and ranks: those on ranks, and copies."""
    alone: dict[str, dict[int, Outcome]] = {}
    copies: dict[str, dict[int, Outcome]] = {}
    for o in row:
        if o.verified and o.first.role in ("", COPIES):
            of = copies if o.first.role == COPIES else alone
            of.setdefault(base_label(o), {})[o.first.ranks] = o
    return alone, copies


def blocks(o: Outcome, phase: str) -> dict[Block, float]:
    """Give the seconds of preparing or solving of each repeat that has them."""
    found = {(r.session, r.repeat): getattr(r, f"{phase}_seconds") for r in o.records}
    return {block: float(t) for block, t in found.items() if t}


def _ratio(
    a: Outcome, b: Outcome, phase: str, *, paired: bool = True
) -> Interval | None:
    """Compare times of a with those of b; from one run each, without an interval.

    paired : whether blocks of the same name ran next to each other
    """
    of_a, of_b = blocks(a, phase), blocks(b, phase)
    if not of_a or not of_b:
        return None
    found: Ratio | None = paired_ratio(of_a, of_b) if paired else None
    found = found or unpaired_ratio(of_a.values(), of_b.values())
    if found is None:
        value = median(of_a.values()) / median(of_b.values())
        return Interval(value, value, value, 0.0, 1)
    return Interval(found.value, found.low, found.high, COVERAGE, found.pairs)


def _times(interval: Interval | None, factor: float) -> Interval | None:
    if interval is None:
        return None
    value, low, high = (factor * v for v in interval[:3])
    return interval._replace(value=value, low=low, high=high)


def rank_parts(o: Outcome) -> dict[str, Part]:
    """Give the seconds of the solve that ranks spent on each of its parts, by name."""
    return _parts(r.rank_seconds for r in o.records)


def rank_counts(o: Outcome) -> dict[str, Part]:
    """Count what ranks sent in the solve: reductions, messages and bytes."""
    return _parts(r.rank_counts for r in o.records)


def rank_memory(o: Outcome) -> Part | None:
    """Give the peak memory of a rank, MiB."""
    ends = ("mean", "largest")
    told = [[r.reported.get(f"rank_peak_mib_{end}") for end in ends] for r in o.records]
    known = [of for of in told if all(isinstance(v, int | float) for v in of)]
    if not known:
        return None
    mean, largest = np.median(np.array(known, dtype=float), axis=0)
    return Part(float(mean), float(largest))


def _parts(tables: Iterable[Mapping[str, Any]]) -> dict[str, Part]:
    known = [table for table in tables if table]
    return {
        name: Part(*(float(median(t[name][end] for t in known)) for end in (0, 1)))
        for name in (known[0] if known else ())
        if all(name in t for t in known)
    }


def _communication(r: Any) -> Communication | None:
    counts, network = r.rank_counts, r.rank_network
    counted = ("reductions", "messages", "bytes")
    timed = ("reduction_seconds", "message_seconds", "seconds_per_byte")
    if r.ranks < 2 or not {*counted} <= {*counts} or not {*timed} <= {*network}:
        return None
    reductions, messages, sent = (float(counts[name][1]) for name in counted)
    return Communication(
        ranks=r.ranks, reductions=reductions, messages=messages, sent=sent,
        **{name: float(network[name][0]) for name in timed},
    )  # fmt: skip


def _cpus(evidence: Evidence) -> int | None:
    machine = evidence.environment.get("machine", {})
    usable = machine.get("usable_cores") if isinstance(machine, Mapping) else None
    return usable if isinstance(usable, int) else None
