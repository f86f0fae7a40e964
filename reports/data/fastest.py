"""The fastest solver at equal verified accuracy, per form, and its significance.

A solver competes if it was verified on every case of the group that at least one solver
solved, and if it reused no answers of earlier solves (`Record.remembered`). The first
competitor is the one with the smallest geometric mean of times. It is called the
fastest only if every other competitor is significantly slower:

- with at least `CASES` cases, if the interval of the ratio over the cases is above 1;
- with fewer cases, if the interval of the ratio within blocks (repeats of one session)
  is above 1 on each case.

If two solvers were measured in different sessions, the interval of the unpaired ratio
must be above 1 on each case, for any number of cases.

Each interval by itself has 95 % coverage. The first solver is wrongly called the
fastest only if the interval of a competitor that is not slower misses its true ratio;
therefore this intersection-union test needs no correction for the number of
solvers [1]_.

References
----------
.. [1] R. L. Berger, Multiparameter Hypothesis Testing and Acceptance Sampling,
   Technometrics 24 (1982) 295-300

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from mortarbench.harness import Verdict
from mortarbench.harness.running.pairs import Ratio, paired_ratio, ratio_of
from mortarbench.reports.data.comparison_groups import (
    CASES,
    Answers,
    ComparisonGroup,
    GroupKey,
    Row,
    time_of,
)
from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.statistics.resampling import symmetric_interval


class Finding(Enum):
    """Conclusions on the fastest solver of a group, or the reason why none is named."""

    FASTEST = "one solver is faster than all others"
    TIE = "the first is not significantly faster than all others"
    DIVIDED = "on few cases, different solvers are fastest"
    ONE_BLOCK = "few cases, and too few blocks for an interval"
    ALONE = "no other solver was measured"
    ONE_COMPLETE = "only one solver was verified on every case"
    NONE_COMPLETE = "no solver was verified on every case"
    NONE_VERIFIED = "there is no verified answer"
    UNFINISHED = "no case was measured with all solvers"


@dataclass(frozen=True, kw_only=True)
class Competitor:
    """A solver of a comparison, and its times relative to the first solver."""

    solver: str
    outcomes: Mapping[str, Outcome]  #: outcomes by case
    compared: tuple[str, ...] = ()  #: cases that this and the first solver solved
    slower: bool = False  #: True if significantly slower than the first solver
    #: ratio over the cases, or within the blocks of a single case
    ratio: Ratio | None = None
    #: ratios within blocks (unpaired if fewer than two blocks are common), by case
    by_case: Mapping[str, Ratio] = field(default_factory=dict)
    form: str = ""  #: form of the QPs; empty unless forms are compared
    #: True if `ratio` is over cases, and on some case that both solved, the solver has
    #: no block in common with the first solver
    apart: bool = False
    remembers: bool = False  #: True if the solver reuses answers of earlier solves

    @property
    def verified(self) -> tuple[str, ...]:
        """Cases with a verified answer."""
        return tuple(
            case for case, o in self.outcomes.items() if time_of(o) is not None
        )

    @property
    def closest(self) -> Ratio | None:
        """Ratio over the cases; for few cases, the smallest ratio on a single case."""
        few = min(self.by_case.values(), key=lambda r: r.value, default=None)
        return few if self.ratio is None else self.ratio


@dataclass(frozen=True, kw_only=True)
class FastestSolver:
    """Comparison of the solvers of one group, see `GroupKey`.

    Competitors are sorted by the geometric mean of their times. The cases are those on
    which all solvers were measured and which at least one solver solved.
    """

    key: GroupKey
    finding: Finding
    cases: tuple[str, ...]
    competitors: tuple[Competitor, ...]
    others: tuple[Competitor, ...]  #: solvers that were not verified on every case
    over_cases: bool  #: True if ratios are over cases, False if within blocks
    unsolved: int  #: number of cases without a verified answer
    notes: tuple[str, ...]  #: notes on missing measurements and different sessions

    @property
    def first(self) -> Competitor:
        """Competitor with the smallest geometric mean; requires at least one."""
        return self.competitors[0]

    @property
    def tied(self) -> tuple[Competitor, ...]:
        """The other competitors that are not significantly slower than the first."""
        return tuple(c for c in self.competitors[1:] if not c.slower)

    @property
    def remembering(self) -> tuple[Competitor, ...]:
        """The solvers that reuse answers of earlier solves."""
        return tuple(c for c in self.others if c.remembers)

    @property
    def following(self) -> Competitor | None:
        """First of the significantly slower competitors, or None."""
        return next((c for c in self.competitors[1:] if c.slower), None)

    def fronts(self) -> dict[str, tuple[Competitor, ...]]:
        """Return, by case, the fastest competitor and all competitors tied with it.

        A competitor without an interval of the ratio to the fastest counts as tied.
        """
        fronts = {}
        for case in self.cases:
            answers = [(c, c.outcomes[case]) for c in self.competitors]
            first, its = min(answers, key=lambda each: time_of(each[1]) or np.inf)
            ratios = [(c, ratio_of(o.by_block, its.by_block)) for c, o in answers]
            tied = (c for c, r in ratios if r is None or r.low <= 1)
            fronts[case] = (first, *(c for c in tied if c is not first))
        return fronts


class Unverified(NamedTuple):
    """Answers of one solver that share a verdict other than verified."""

    solver: str
    verdict: Verdict
    answers: tuple[Outcome, ...]
    of: int  #: number of all answers of the solver, including declined ones


def fastest_solvers(
    answers: Answers, groups: Iterable[ComparisonGroup]
) -> tuple[FastestSolver, ...]:
    """Find the fastest solver of every group."""
    return tuple(
        _fastest(group, {case: answers[group.key][case] for case in group.cases})
        for group in groups
    )


def unverified(rows: Iterable[Row]) -> list[Unverified]:
    """Collect unverified answers by solver and verdict, most frequent first."""
    answered = Counter[str]()
    failed: dict[tuple[str, Verdict], list[Outcome]] = {}
    for row in rows:
        for solver, o in row.items():
            answered[solver] += 1
            if not o.verified:
                failed.setdefault((solver, o.verdict), []).append(o)
    solvers = list(answered)
    return sorted(
        (
            Unverified(*key, tuple(those), answered[key[0]])
            for key, those in failed.items()
        ),
        key=lambda one: (-len(one.answers), solvers.index(one.solver)),
    )


def _fastest(group: ComparisonGroup, rows: Mapping[str, Row]) -> FastestSolver:
    solved = {
        case: row
        for case, row in rows.items()
        if any(time_of(row[s]) is not None for s in group.solvers)
    }
    # a sequence that ended early may leave too few solved cases
    over_cases = group.comparable and len(solved) >= CASES
    entered = [
        Competitor(
            solver=s,
            outcomes={case: row[s] for case, row in solved.items()},
            remembers=any(row[s].remembered for row in rows.values()),
        )
        for s in group.solvers
    ]
    full = [
        c for c in entered if len(c.verified) == len(solved) > 0 and not c.remembers
    ]
    full.sort(key=_geometric_mean)
    others = [c for c in entered if c not in full]
    others.sort(key=lambda c: (c.remembers, -len(c.verified)))
    if full:
        first = full[0]
        compared = [_compared(c, first, group, over_cases) for c in full[1:]]
        full[1:] = sorted(compared, key=_geometric_mean)
        others = [_compared(c, first, group, over_cases) for c in others]
    return FastestSolver(
        key=group.key,
        finding=_finding(group, solved, full, over_cases=over_cases),
        cases=tuple(solved),
        competitors=tuple(full),
        others=tuple(others),
        over_cases=over_cases,
        unsolved=len(rows) - len(solved),
        notes=group.unmeasured + group.sessions,
    )


def _geometric_mean(c: Competitor) -> float:
    return float(np.mean([np.log(time_of(o) or np.inf) for o in c.outcomes.values()]))


def _compared(
    c: Competitor, first: Competitor, group: ComparisonGroup, over_cases: bool
) -> Competitor:
    """Compare a competitor with the first one on the cases that both solved.

    On each case, the ratio is taken within the blocks in which both
    were measured (unpaired if there are fewer than two such blocks). Over cases, each
    end of Student's interval is moved out to the end of the sign-flip interval if that
    end is farther out. Student's interval assumes normally distributed logarithms of
    ratios, the sign-flip interval only a symmetric distribution. Neither assumption is
    safe for six cases, so both intervals must exclude 1 for a significant difference.
    """
    both = c.verified
    paired = {
        case: ratio_of(c.outcomes[case].by_block, first.outcomes[case].by_block)
        for case in both
    }
    by_case = {case: ratio for case, ratio in paired.items() if ratio is not None}
    on_cases = replace(c, compared=both, by_case=by_case)
    if not over_cases:
        every = len(by_case) == len(c.outcomes)
        slower = every and all(ratio.low > 1 for ratio in by_case.values())
        only = by_case.get(both[0]) if len(both) == len(c.outcomes) == 1 else None
        return replace(on_cases, ratio=only, slower=slower)
    mine, its = (
        {i: time_of(one.outcomes[case]) or 0.0 for i, case in enumerate(both)}
        for one in (c, first)
    )
    ratio = paired_ratio(mine, its) if len(both) >= CASES else None
    if ratio is not None:
        logs = np.log([mine[i] / its[i] for i in mine])
        low, high = map(float, np.exp(symmetric_interval(logs, both)))
        ratio = ratio._replace(low=min(ratio.low, low), high=max(ratio.high, high))
    slower, apart = ratio is not None and ratio.low > 1, False
    if group.apart.any():  # different sessions have no common blocks to pair
        one, other = (group.solvers.index(s.solver) for s in (first, c))
        apart = bool(group.apart[one, other])
        slower = slower and (not apart or bool(group.faster[one, other]))
    return replace(on_cases, ratio=ratio, slower=slower, apart=apart)


def _finding(
    group: ComparisonGroup,
    solved: Mapping[str, Row],
    full: Sequence[Competitor],
    *,
    over_cases: bool,
) -> Finding:
    if not group.cases or not group.solvers:
        return Finding.UNFINISHED
    if not solved:
        return Finding.NONE_VERIFIED
    if len(group.solvers) == 1:
        return Finding.ALONE
    if len(full) < 2:
        return Finding.ONE_COMPLETE if full else Finding.NONE_COMPLETE
    if all(c.slower for c in full[1:]):
        return Finding.FASTEST
    if over_cases:
        return Finding.TIE
    if any(len(c.by_case) < len(solved) for c in full[1:]):
        return Finding.ONE_BLOCK
    faster = any(r.high < 1 for c in full[1:] for r in c.by_case.values())
    return Finding.DIVIDED if faster else Finding.TIE
