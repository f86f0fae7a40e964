"""Times of all solvers on all cases of a group, for means, ranks and profiles."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from typing import NamedTuple, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from mortarbench.harness import Record, Verdict
from mortarbench.harness.running.pairs import ratio_of
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.document.formatting import clean, listing, plural, tolerance

#: With fewer no two solvers can be told apart, see `reports.statistics.resampling`.
CASES = 6
POOLED = "all forms"  #: instead of a form, of a group that cases of every form are in
LARGEST_SHIFT = 10.0  #: s, the customary shift, which is too large for short times

_CELL = ["kind", "case", "solver"]

Times = NDArray[np.float64]
Pairs = NDArray[np.bool_]
Row = Mapping[str, Outcome]  #: by solver
Name = TypeVar("Name")


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
    told: Pairs = field(default_factory=_no_pairs)
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
    if not records:
        return ()
    of = [kind_of(r, pool_forms=pool_forms) for r in records]
    kinds = _numbered(of)
    cases = _numbered(r.case for r in records)
    solvers = _numbered(evidence.solvers)
    verified = np.array([r.verdict.is_verified for r in records])
    outcomes = _outcomes(
        pd.DataFrame(
            {
                "kind": [kinds[kind] for kind in of],
                "case": [cases[r.case] for r in records],
                "solver": [solvers[r.solver] for r in records],
                "tol": [r.tol for r in records],
                "seconds": np.array([r.total_seconds for r in records], dtype=float),
                "verified": verified,
                "claimed": [r.claims_answer for r in records],
                # one repeat in time is no answer yet
                "late": [r.verdict is Verdict.TIME_LIMIT for r in records] | verified,
                "declined": [r.verdict is Verdict.DECLINED for r in records],
            }
        )
    )
    limit = _limit(evidence, outcomes)
    found = tuple(
        _group(kind, group, [*cases], evidence.solvers, limit)
        for kind, (_, group) in zip(kinds, outcomes.groupby("kind"), strict=True)
    )
    if len({r.session for r in records}) > 1:
        answers = answers_of(evidence, pool_forms=pool_forms)
        found = tuple(_with_sessions(group, answers[group.kind]) for group in found)
    if not pool_forms:
        return found
    form = {r.case: r.form for r in records}
    return tuple(
        replace(group, forms=Counter(form[case] for case in group.cases))
        for group in found
    )


def answers_of(evidence: Evidence, *, pool_forms: bool = False) -> Answers:
    """Choose the answer of every solver to every case; null arms take no part."""
    found: dict[Kind, dict[str, dict[str, list[Outcome]]]] = {}
    for o in evidence.flat:
        if not o.first.role:
            cases = found.setdefault(kind_of(o.first, pool_forms=pool_forms), {})
            cases.setdefault(o.case, {}).setdefault(o.solver, []).append(o)
    return {
        kind: {
            case: {solver: representative(given) for solver, given in row.items()}
            for case, row in cases.items()
        }
        for kind, cases in found.items()
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
    apart, told = np.zeros((n, n), dtype=bool), np.zeros((n, n), dtype=bool)
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
        told[i, j] = all(r is not None and r.high < 1 for r in ratios)
        told[j, i] = all(r is not None and r.low > 1 for r in ratios)
    return replace(group, apart=apart, told=told)


def kind_of(r: Record, *, pool_forms: bool = False) -> Kind:
    """Return what a record has in common with those that it is compared with."""
    form = POOLED if pool_forms else r.form
    swept = r.accuracy is not None
    return Kind(swept, r.mode, form, r.tol if r.accuracy is None else r.accuracy)


def _numbered(names: Iterable[Name]) -> dict[Name, int]:
    """Map names to numbers in their order: pandas does not accept every name."""
    return {name: number for number, name in enumerate(dict.fromkeys(names))}


def _outcomes(records: pd.DataFrame) -> pd.DataFrame:
    """Put repeats together, then the tolerances of a sweep: one row per cell."""
    repeats = records.groupby([*_CELL, "tol"], sort=False).agg(
        seconds=("seconds", "median"),
        verified=("verified", "all"),
        claimed=("claimed", "all"),
        late=("late", "all"),
        declined=("declined", "all"),
    )
    time = repeats["seconds"]
    timed = time > 0
    late = repeats["late"] & ~repeats["verified"]
    columns = pd.DataFrame(
        {
            "times": time.where(repeats["verified"] & timed, np.inf),
            "claimed": time.where(repeats["claimed"] & timed, np.inf),
            "stopped": time.fillna(np.inf).where(late, np.nan),  # inf: at the limit
            "declined": repeats["declined"].astype(float),
            "longest": time,
        }
    )
    return (
        columns.groupby(level=_CELL, sort=False)
        .agg(
            times=("times", "min"),
            claimed=("claimed", "min"),
            stopped=("stopped", "max"),
            declined=("declined", "min"),
            longest=("longest", "max"),
        )
        .reset_index()
    )


def _limit(evidence: Evidence, outcomes: pd.DataFrame) -> float:
    """Take the suite's limit of time, or else the longest measurement."""
    asked = evidence.suite.get("time_limit")
    if isinstance(asked, int | float) and asked > 0:
        return float(asked)
    longest = float(outcomes["longest"].max())
    return longest if longest > 0 else 1.0


def _group(
    kind: Kind,
    group: pd.DataFrame,
    cases: Sequence[str],
    solvers: Sequence[str],
    limit: float,
) -> ComparisonGroup:
    """Keep the solvers with at least half of the cases, and cases that they all had."""
    wide = group.pivot(index="case", columns="solver")
    present = np.array([cases[i] for i in wide.index], dtype=object)
    met = np.array([solvers[i] for i in wide["times"].columns], dtype=object)

    def matrix(name: str) -> Times:
        return wide[name].to_numpy(dtype=float)

    times, declined = matrix("times"), matrix("declined")
    seen = ~np.isnan(times)
    refused = (declined == 1).sum(axis=0) == seen.sum(axis=0)
    rare = ~refused & (2 * seen.sum(axis=0) < len(present))
    taken = ~(refused | rare)
    complete = seen[:, taken].all(axis=1)
    part = np.ix_(complete, taken)
    stopped = matrix("stopped")[part]
    return ComparisonGroup(
        kind=kind,
        cases=tuple(present[complete]),
        solvers=tuple(met[taken]),
        times=times[part],
        claimed=matrix("claimed")[part],
        stopped=np.where(np.isinf(stopped), limit, stopped),
        limit=limit,
        refused=tuple(met[refused]),
        rare=tuple(met[rare]),
        incomplete=int((~complete).sum()),
    )
