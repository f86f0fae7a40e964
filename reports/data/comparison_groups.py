"""Times of all solvers on all cases of a group, for means, rankings and profiles."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Record, Verdict
from mortarbench.harness.running.pairs import ratio_of
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.document.formatting import clean, listing, plural, tolerance

#: Minimum number of cases of a comparison. With fewer cases, no sign test is
#: significant at the 5 % level: five signs agree by chance with probability 2/2⁵.
CASES = 6
POOLED = "all forms"  #: name that replaces the form if cases of all forms are pooled
LARGEST_SHIFT = 10.0  #: s; the customary shift, which is too large for short times

#: verdicts allowed for the repeats of an outcome that counts as out of time
_LATE = {v for v in Verdict if v is Verdict.TIME_LIMIT or v.is_verified}

Times = NDArray[np.float64]
Pairs = NDArray[np.bool_]
Row = Mapping[str, Outcome]  #: outcomes by solver
Cells = dict[str, dict[str, list[Outcome]]]  #: outcomes by case and solver


def _no_pairs() -> Pairs:
    return np.zeros((0, 0), dtype=bool)


class GroupKey(NamedTuple):
    """Attributes that the cases of one group share."""

    sweep: bool  #: True if several tolerances are measured for one accuracy
    mode: str
    form: str
    at: float  #: accuracy at which answers are judged

    @property
    def accuracy(self) -> str:
        """Name of the common accuracy."""
        return f"{'accuracy' if self.sweep else 'tol'} {tolerance(self.at)}"

    @property
    def subject(self) -> str:
        """Name of the form, with the mode unless it is cold; may be empty."""
        parts = [clean(self.form, 24)] * bool(self.form)
        return ", ".join([*parts, *[clean(self.mode, 24)] * (self.mode != "cold")])

    @property
    def title(self) -> str:
        """Subject and accuracy."""
        return ", ".join(filter(None, (self.subject, self.accuracy)))


Answers = Mapping[GroupKey, Mapping[str, Row]]  #: outcomes by group and case


@dataclass(frozen=True, eq=False, kw_only=True)
class ComparisonGroup:
    """Cases that share a group key, and the solvers measured on all these cases.

    Copies and null arms (a solver repeated under a second label) are left out. Times
    are medians of prepare + solve over the repeats. If several tolerances were swept,
    the time of the fastest verified (or claimed) answer is used.
    """

    key: GroupKey
    cases: tuple[str, ...]
    solvers: tuple[str, ...]
    times: Times  #: (cases, solvers) s; inf unless every repeat was verified
    claimed: Times  #: (cases, solvers) s; inf unless every repeat claimed success, or
    #: correctly claimed infeasibility
    stopped: Times  #: (cases, solvers) s, if ended by the time limit; else NaN
    limit: float  #: time limit per measurement, s; if unlimited, the longest time
    refused: tuple[str, ...] = ()  #: solvers that declined all cases
    rare: tuple[str, ...] = ()  #: solvers measured on fewer than half of the cases
    forms: Mapping[str, int] = field(default_factory=dict)  #: cases by form, if pooled
    incomplete: int = 0  #: number of cases left out because a measurement is missing
    apart: Pairs = field(default_factory=_no_pairs)
    "(solvers, solvers) True if two solvers have no common block on some case that "
    "both solved; may be empty."
    faster: Pairs = field(default_factory=_no_pairs)
    "(solvers, solvers) True if `apart`, and the row solver is significantly faster "
    "than the column solver on every case."

    @property
    def title(self) -> str:
        """Form, mode (unless it is cold) and accuracy."""
        return self.key.title

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on forms, and on solvers and cases that are left out."""
        counted = ", ".join(
            f"{clean(form, 24)} {plural(n, 'case')}" for form, n in self.forms.items()
        )
        pooled = (
            f"Pooled forms: {counted}. Cases of a form that a solver declines count as "
            "unsolved."
        )
        refused = f"Solvers that declined all cases: {listing(self.refused, 6)}."
        notes = (pooled,) * bool(self.forms) + (refused,) * bool(self.refused)
        return notes + self.unmeasured + self.sessions

    @property
    def unmeasured(self) -> tuple[str, ...]:
        """Notes on solvers and cases with missing measurements."""
        notes = []
        if self.rare:
            rare = listing(self.rare, 6)
            notes.append(
                "Left out because they were measured on less than half of "
                f"the cases: {rare}."
            )
        if self.incomplete:
            cases = plural(self.incomplete, "case")
            notes.append(
                f"Left out because they were not measured with all solvers: {cases}."
            )
        return tuple(notes)

    @property
    def sessions(self) -> tuple[str, ...]:
        """Note on solvers that were measured in different sessions."""
        remaining = self.apart.copy()
        pairs = []
        while remaining.any():
            late = int(remaining.sum(axis=1).argmax())
            others = [self.solvers[i] for i in np.flatnonzero(remaining[late])]
            pairs.append(f"{clean(self.solvers[late], 40)} with {listing(others, 4)}")
            remaining[late] = remaining[:, late] = False
        if not pairs:
            return ()
        return (
            "Measured in different sessions, without common blocks; therefore a "
            "difference is significant only if the unpaired interval excludes 1 on "
            f"every case: {'; '.join(pairs)}.",
        )

    @property
    def comparable(self) -> bool:
        """True if cases, solvers and answers suffice for a comparison over cases."""
        return not self.lack

    @property
    def lack(self) -> str:
        """Reason why cases cannot be compared; empty if they can."""
        if len(self.solvers) < 2:
            return plural(len(self.solvers), "solver")
        if len(self.cases) < CASES:
            return plural(len(self.cases), "case")
        return "" if self.solved.any() else "no verified answer"

    @cached_property
    def solved(self) -> NDArray[np.bool_]:
        """(cases, solvers) True where the answer is verified."""
        return np.isfinite(self.times)

    @cached_property
    def shift(self) -> float:
        """Shift of means: median of the best times of solved cases, at most 10 s."""
        best = self.times.min(axis=1)
        return float(min(LARGEST_SHIFT, np.median(best[np.isfinite(best)])))

    @cached_property
    def horizon(self) -> float:
        """Time limit, or the longest time of an answer if it exceeds the limit; s."""
        both = np.concatenate([self.times, self.claimed])
        return float(max(self.limit, both[np.isfinite(both)].max()))


def comparison_groups(
    evidence: Evidence, *, pool_forms: bool = False
) -> tuple[ComparisonGroup, ...]:
    """Return the groups of `all_groups` that can be compared over cases.

    Such groups have at least `CASES` cases, two solvers and one verified answer.
    """
    groups = all_groups(evidence, pool_forms=pool_forms)
    return tuple(group for group in groups if group.comparable)


def all_groups(
    evidence: Evidence, *, pool_forms: bool = False
) -> tuple[ComparisonGroup, ...]:
    """Group the measurements by form, mode and accuracy.

    Forms are separate, since the primal and the dual QP of one problem are different
    problems for a solver. Cold solves and sequences are also separate.

    pool_forms : group by mode and accuracy only; each QP remains a separate case
    """
    records = [r for r in evidence.records if not r.arm]
    cells = _cells(evidence, pool_forms=pool_forms)
    time_limit = evidence.suite.get("time_limit")
    if isinstance(time_limit, int | float) and time_limit > 0:
        limit = float(time_limit)
    else:  # the longest measured time
        every = (o for o in evidence.flat if not o.first.arm)
        limit = max((t for t in map(_seconds, every) if t > 0), default=1.0)
    groups = [_group(key, of, evidence.solvers, limit) for key, of in cells.items()]
    if len({r.session for r in records}) > 1:
        groups = [_with_sessions(g, _answers(cells[g.key])) for g in groups]
    if pool_forms:
        form = {r.case: r.form for r in records}
        groups = [
            replace(group, forms=Counter(form[case] for case in group.cases))
            for group in groups
        ]
    return tuple(groups)


def answers_of(evidence: Evidence, *, pool_forms: bool = False) -> Answers:
    """Select the answer of every solver to every case; omit null arms."""
    cells = _cells(evidence, pool_forms=pool_forms)
    return {key: _answers(rows) for key, rows in cells.items()}


def _cells(evidence: Evidence, *, pool_forms: bool) -> dict[GroupKey, Cells]:
    """Group outcomes by group key, case and solver; a tolerance sweep is one cell."""
    cells: dict[GroupKey, Cells] = {}
    for o in evidence.flat:
        if not o.first.arm:
            cases = cells.setdefault(group_key(o.first, pool_forms=pool_forms), {})
            cases.setdefault(o.case, {}).setdefault(o.solver, []).append(o)
    return cells


def _answers(cells: Cells) -> dict[str, Row]:
    return {
        case: {solver: representative(outcomes) for solver, outcomes in row.items()}
        for case, row in cells.items()
    }


def representative(outcomes: Sequence[Outcome]) -> Outcome:
    """Return one of a solver's answers to a case at several tolerances.

    Return the fastest verified answer or, if no answer is verified, the answer at the
    tightest tolerance.
    """
    timed = [(t, -o.tol, o) for o in outcomes if (t := time_of(o)) is not None]
    if timed:
        return min(timed, key=lambda each: each[:2])[-1]
    return min(outcomes, key=lambda o: o.tol)


def time_of(outcome: Outcome) -> float | None:
    """Return the median total time, s; None if unverified or without a known time."""
    time = outcome.seconds("total") if outcome.verified else None
    return time.value if time is not None and time.value > 0 else None


def _with_sessions(group: ComparisonGroup, rows: Mapping[str, Row]) -> ComparisonGroup:
    """Mark pairs of solvers without a common block on some case that both solved."""
    n = len(group.solvers)
    apart, faster = np.zeros((n, n), dtype=bool), np.zeros((n, n), dtype=bool)
    for i, j in combinations(range(n), 2):
        pairs = [
            tuple(
                rows[case][group.solvers[s]].by_block if group.solved[k, s] else {}
                for s in (i, j)
            )
            for k, case in enumerate(group.cases)
        ]
        if all(a.keys() & b.keys() for a, b in pairs if a and b):
            continue
        apart[i, j] = apart[j, i] = True
        ratios = [ratio_of(a, b) if a and b else None for a, b in pairs]
        faster[i, j] = all(r is not None and r.high < 1 for r in ratios)
        faster[j, i] = all(r is not None and r.low > 1 for r in ratios)
    return replace(group, apart=apart, faster=faster)


def group_key(r: Record, *, pool_forms: bool = False) -> GroupKey:
    """Return the key of the group that a record belongs to."""
    form = POOLED if pool_forms else r.form
    swept = r.accuracy is not None
    return GroupKey(swept, r.mode, form, r.tol if r.accuracy is None else r.accuracy)


def _seconds(outcome: Outcome) -> float:
    """Return the median total time, s; NaN if it is unknown."""
    time = outcome.seconds("total")
    return np.nan if time is None else time.value


def _group(
    key: GroupKey, cells: Cells, solvers: Sequence[str], limit: float
) -> ComparisonGroup:
    """Form a group without the solvers that are `refused` or `rare`."""
    present = np.array([*cells], dtype=object)
    measured = {solver for row in cells.values() for solver in row}
    labels = np.array([s for s in solvers if s in measured], dtype=object)
    matrices = np.full((4, len(present), len(labels)), np.nan)
    for k, row in enumerate(cells.values()):
        for i, solver in enumerate(labels):
            if solver in row:
                matrices[:, k, i] = _cell(row[solver])
    times, claimed, stopped, declined = matrices
    stopped = np.where(np.isinf(stopped), limit, stopped)
    seen = ~np.isnan(times)
    refused = (declined == 1).sum(axis=0) == seen.sum(axis=0)
    rare = ~refused & (2 * seen.sum(axis=0) < len(present))
    taken = ~(refused | rare)
    complete = seen[:, taken].all(axis=1)
    part = np.ix_(complete, taken)
    return ComparisonGroup(
        key=key,
        cases=tuple(present[complete]),
        solvers=tuple(labels[taken]),
        times=times[part],
        claimed=claimed[part],
        stopped=stopped[part],
        limit=limit,
        refused=tuple(labels[refused]),
        rare=tuple(labels[rare]),
        incomplete=int((~complete).sum()),
    )


def _cell(outcomes: Sequence[Outcome]) -> tuple[float, ...]:
    """Return a solver's `times`, `claimed`, `stopped` on a case, and 1 if declined."""
    times = [(_seconds(o), o) for o in outcomes]
    verified = [t for t, o in times if o.verified and t > 0]
    claimed = [t for t, o in times if t > 0 and all(r.claims_answer for r in o.records)]
    stopped = [
        np.inf if np.isnan(t) else t
        for t, o in times
        if not o.verified and all(r.status in _LATE for r in o.records)
    ]
    declined = all(r.status is Verdict.DECLINED for o in outcomes for r in o.records)
    return (
        min(verified, default=np.inf),
        min(claimed, default=np.inf),
        max(stopped, default=np.nan),
        float(declined),
    )
