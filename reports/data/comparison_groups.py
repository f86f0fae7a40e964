"""Times of all solvers on all cases of a group, for means, ranks and profiles."""

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

#: With fewer no two solvers can be told apart, see `reports.statistics.resampling`.
CASES = 6
POOLED = "all forms"  #: instead of a form, of a group that cases of every form are in
LARGEST_SHIFT = 10.0  #: s, the customary shift, which is too large for short times

#: of repeats that all ran out of time, but for some that were verified before
_LATE = {v for v in Verdict if v is Verdict.TIME_LIMIT or v.is_verified}

Times = NDArray[np.float64]
Pairs = NDArray[np.bool_]
Row = Mapping[str, Outcome]  #: by solver
Cells = dict[str, dict[str, list[Outcome]]]  #: outcomes by case and solver


def _no_pairs() -> Pairs:
    return np.zeros((0, 0), dtype=bool)


class Kind(NamedTuple):
    """Attributes that the cases of one group share."""

    sweep: bool  #: of the tolerance asked for
    mode: str
    form: str
    at: float  #: accuracy that answers are judged at

    @property
    def accuracy(self) -> str:
        """Name the accuracy that all answers have in common."""
        return f"{'accuracy' if self.sweep else 'tol'} {tolerance(self.at)}"

    @property
    def subject(self) -> str:
        """Name the form, and the mode where it is not cold; empty without a form."""
        parts = [clean(self.form, 24)] * bool(self.form)
        return ", ".join([*parts, *[clean(self.mode, 24)] * (self.mode != "cold")])

    @property
    def title(self) -> str:
        """Name all of it."""
        return ", ".join(filter(None, (self.subject, self.accuracy)))


Answers = Mapping[Kind, Mapping[str, Row]]  #: by what they have in common, and case


@dataclass(frozen=True, eq=False, kw_only=True)
class ComparisonGroup:
    """Cases of one form at one accuracy, and the solvers that were measured on each.

    Null arms take no part. Times are medians of prepare + solve over the repeats; in a
    sweep of tolerances, those of the cheapest answer that counts.
    """

    kind: Kind
    cases: tuple[str, ...]
    solvers: tuple[str, ...]
    times: Times  #: (cases, solvers) s; inf unless every repeat was verified
    claimed: Times  #: the same; inf unless every repeat was claimed to be solved, or is
    #: rightly claimed to be infeasible
    stopped: Times  #: s after which time ran out; NaN where that was not the end
    limit: float  #: s per measurement; the longest one, where the suite has no limit
    refused: tuple[str, ...] = ()  #: solvers that declined all cases
    rare: tuple[str, ...] = ()  #: solvers measured on fewer than half of them
    forms: Mapping[str, int] = field(default_factory=dict)  #: cases of each, if pooled
    incomplete: int = 0  #: cases left out, since some solver was not measured on them
    apart: Pairs = field(default_factory=_no_pairs)
    """(solvers, solvers) whether two share no block on some case; none: all share."""
    faster: Pairs = field(default_factory=_no_pairs)
    """(solvers, solvers) of those, True if row is faster than column on every case."""

    @property
    def title(self) -> str:
        """Form and accuracy."""
        return self.kind.title

    @property
    def notes(self) -> tuple[str, ...]:
        """Name what takes no part."""
        counted = ", ".join(
            f"{clean(form, 24)} {plural(n, 'case')}" for form, n in self.forms.items()
        )
        pooled = (
            f"Forms together: {counted}. A form that a solver declines is "
            "unsolved by it."
        )
        refused = f"Declined all of them: {listing(self.refused, 6)}."
        said = (pooled,) * bool(self.forms) + (refused,) * bool(self.refused)
        return said + self.unmeasured + self.sessions

    @property
    def unmeasured(self) -> tuple[str, ...]:
        """Name what takes no part because it was not measured."""
        rare = f"Measured on fewer than half of them: {listing(self.rare, 6)}."
        left = f"Not measured by all, left out: {plural(self.incomplete, 'case')}."
        return (rare,) * bool(self.rare) + (left,) * bool(self.incomplete)

    @property
    def sessions(self) -> tuple[str, ...]:
        """Name solvers that were measured in different sessions."""
        left = self.apart.copy()
        pairs = []
        while left.any():
            late = int(left.sum(axis=1).argmax())
            others = [self.solvers[i] for i in np.flatnonzero(left[late])]
            pairs.append(f"{clean(self.solvers[late], 40)} with {listing(others, 4)}")
            left[late] = left[:, late] = False
        if not pairs:
            return ()
        return (
            "Measured in different sessions, not within blocks, and told apart only "
            "where the unpaired interval excludes 1 on every case: "
            f"{'; '.join(pairs)}.",
        )

    @property
    def comparable(self) -> bool:
        """True if cases, solvers and answers suffice for a statement over cases."""
        return not self.lack

    @property
    def lack(self) -> str:
        """The lack that prevents a statement over cases; empty without one."""
        if len(self.solvers) < 2:
            return plural(len(self.solvers), "solver")
        if len(self.cases) < CASES:
            return plural(len(self.cases), "case")
        return "" if self.solved.any() else "no verified answer"

    @cached_property
    def solved(self) -> NDArray[np.bool_]:
        """(cases, solvers) whether verified."""
        return np.isfinite(self.times)

    @cached_property
    def shift(self) -> float:
        """Shift of geometric means: the median over cases of the best time, ≤ 10 s."""
        best = self.times.min(axis=1)
        return float(min(LARGEST_SHIFT, np.median(best[np.isfinite(best)])))

    @cached_property
    def horizon(self) -> float:
        """The limit, or the longest time of an answer if that is longer; s."""
        both = np.concatenate([self.times, self.claimed])
        return float(max(self.limit, both[np.isfinite(both)].max()))


def comparison_groups(
    evidence: Evidence, *, pool_forms: bool = False
) -> tuple[ComparisonGroup, ...]:
    """Group what was measured, as `all_groups`; groups of few cases are left out.

    At least `CASES` cases, two solvers and one verified answer make a group.
    """
    groups = all_groups(evidence, pool_forms=pool_forms)
    return tuple(group for group in groups if group.comparable)


def all_groups(
    evidence: Evidence, *, pool_forms: bool = False
) -> tuple[ComparisonGroup, ...]:
    """Group what was measured by form and accuracy, whatever can be said of it.

    Forms are apart, since the primal and the dual QP of one problem are two problems to
    a solver; so are cold solves and sequences.

    pool_forms : put all forms into one group; each QP is still a case of its own
    """
    records = [r for r in evidence.records if not r.role]
    cells = _cells(evidence, pool_forms=pool_forms)
    asked = evidence.suite.get("time_limit")
    if isinstance(asked, int | float) and asked > 0:
        limit = float(asked)
    else:  # the longest measurement
        every = (o for o in evidence.flat if not o.first.role)
        limit = max((t for t in map(_seconds, every) if t > 0), default=1.0)
    found = [_group(kind, of, evidence.solvers, limit) for kind, of in cells.items()]
    if len({r.session for r in records}) > 1:
        found = [_with_sessions(group, _answers(cells[group.kind])) for group in found]
    if pool_forms:
        form = {r.case: r.form for r in records}
        found = [
            replace(group, forms=Counter(form[case] for case in group.cases))
            for group in found
        ]
    return tuple(found)


def answers_of(evidence: Evidence, *, pool_forms: bool = False) -> Answers:
    """Choose the answer of every solver to every case; null arms take no part."""
    cells = _cells(evidence, pool_forms=pool_forms)
    return {kind: _answers(rows) for kind, rows in cells.items()}


def _cells(evidence: Evidence, *, pool_forms: bool) -> dict[Kind, Cells]:
    """Group the outcomes of every solver on every case, those of a sweep together."""
    found: dict[Kind, Cells] = {}
    for o in evidence.flat:
        if not o.first.role:
            cases = found.setdefault(kind_of(o.first, pool_forms=pool_forms), {})
            cases.setdefault(o.case, {}).setdefault(o.solver, []).append(o)
    return found


def _answers(cells: Cells) -> dict[str, Row]:
    return {
        case: {solver: representative(outcomes) for solver, outcomes in row.items()}
        for case, row in cells.items()
    }


def representative(outcomes: Sequence[Outcome]) -> Outcome:
    """Choose the answer of a solver on a case: of a sweep, the cheapest verified one.

    Where none is verified, that at the tightest tolerance.
    """
    timed = [(t, -o.tol, o) for o in outcomes if (t := time_of(o)) is not None]
    if timed:
        return min(timed, key=lambda each: each[:2])[-1]
    return min(outcomes, key=lambda o: o.tol)


def time_of(outcome: Outcome) -> float | None:
    """Median total time of a verified answer, s."""
    time = outcome.seconds("total") if outcome.verified else None
    return time.value if time is not None and time.value > 0 else None


def _with_sessions(group: ComparisonGroup, rows: Mapping[str, Row]) -> ComparisonGroup:
    """Mark the solvers that were not measured together on every case."""
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


def kind_of(r: Record, *, pool_forms: bool = False) -> Kind:
    """Return what a record has in common with those that it is compared with."""
    form = POOLED if pool_forms else r.form
    swept = r.accuracy is not None
    return Kind(swept, r.mode, form, r.tol if r.accuracy is None else r.accuracy)


def _seconds(outcome: Outcome) -> float:
    """Median total time, s; NaN without one."""
    time = outcome.seconds("total")
    return np.nan if time is None else time.value


def _group(
    kind: Kind, cells: Cells, solvers: Sequence[str], limit: float
) -> ComparisonGroup:
    """Keep the solvers with at least half of the cases, and cases that they all had."""
    present = np.array([*cells], dtype=object)
    known = {solver for row in cells.values() for solver in row}
    met = np.array([s for s in solvers if s in known], dtype=object)
    matrices = np.full((4, len(present), len(met)), np.nan)
    for k, row in enumerate(cells.values()):
        for i, solver in enumerate(met):
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
        kind=kind,
        cases=tuple(present[complete]),
        solvers=tuple(met[taken]),
        times=times[part],
        claimed=claimed[part],
        stopped=stopped[part],
        limit=limit,
        refused=tuple(met[refused]),
        rare=tuple(met[rare]),
        incomplete=int((~complete).sum()),
    )


def _cell(outcomes: Sequence[Outcome]) -> tuple[float, ...]:
    """Return times, claimed and stopped of a group for one cell, and 1 if declined."""
    times = [(_seconds(o), o) for o in outcomes]
    verified = [t for t, o in times if o.verified and t > 0]
    claimed = [t for t, o in times if t > 0 and all(r.claims_answer for r in o.records)]
    stopped = [
        np.inf if np.isnan(t) else t
        for t, o in times
        if not o.verified and all(r.verdict in _LATE for r in o.records)
    ]
    declined = all(r.verdict is Verdict.DECLINED for o in outcomes for r in o.records)
    return (
        min(verified, default=np.inf),
        min(claimed, default=np.inf),
        max(stopped, default=np.nan),
        float(declined),
    )
