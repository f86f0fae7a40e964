"""Shifted geometric means of times, and the conventions that they depend on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.reports.data.comparison_groups import CASES, ComparisonGroup
from mortarbench.reports.statistics import resampling

Array = NDArray[np.float64]

SHIFTS = (0.01, 1.0, 10.0)
PENALTIES = (1.0, 3.0, 10.0)
GATES = ("verified", "claimed")


@dataclass(frozen=True, kw_only=True)
class Convention:
    """Choices by which times over cases become one number."""

    shift: float = 1.0  #: times that of the group
    penalty: float = 3.0  #: an unsolved case is charged this many limits
    gate: str = "verified"  #: or "claimed": the solver's word is taken
    common: bool = False  #: only cases that all solved, see `common_cases`


USUAL = Convention()  #: what tiers and ratios are made with

#: One thing changed at a time, by the name of its column.
SINGLE = {
    "shift × 0.01": replace(USUAL, shift=0.01),
    "shift × 10": replace(USUAL, shift=10.0),
    "1 limit": replace(USUAL, penalty=1.0),
    "10 limits": replace(USUAL, penalty=10.0),
    "claimed": replace(USUAL, gate="claimed"),
    "common": replace(USUAL, common=True),
}

_SAME = 1e-12  #: relative difference of means that are equal but for rounding

#: Every combination of shift, penalty and gate.
EVERY = tuple(
    Convention(shift=s, penalty=p, gate=g)
    for s, p, g in product(SHIFTS, PENALTIES, GATES)
)


def geometric_means(group: ComparisonGroup, convention: Convention) -> Array:
    """Shifted geometric means exp(mean log(t + s)) − s over the cases, by solver; s.

    An unsolved case counts as `penalty` times the limit. In `common` mode there is none
    to charge, and solvers outside of the comparison have NaN.
    """
    logs, shift = _logs(group, convention)
    if not convention.common:
        return np.asarray(np.exp(logs.mean(axis=0)) - shift)
    rows, columns = common_cases(group)
    means = np.full(len(group.solvers), np.nan)
    if rows.sum() >= CASES:
        means[columns] = np.exp(logs[rows][:, columns].mean(axis=0)) - shift
    return means


def common_cases(group: ComparisonGroup) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Find the cases solved by every solver that solved at least half of them.

    One solver that solves next to nothing would leave no case to compare the others on.

    Returns
    -------
    cases, solvers : which of them

    """
    solvers = group.solved.mean(axis=0) >= 0.5
    cases = np.logical_and.reduce(group.solved[:, solvers], axis=1)
    return np.asarray(cases), np.asarray(solvers)


def _logs(group: ComparisonGroup, convention: Convention) -> tuple[Array, float]:
    """Logarithms of t + s, (cases, solvers), and s in seconds."""
    times = group.times if convention.gate == "verified" else group.claimed
    shift = convention.shift * group.shift
    charged = np.where(np.isinf(times), convention.penalty * group.horizon, times)
    return np.log(charged + shift), shift


@dataclass(frozen=True, eq=False, kw_only=True)
class Ranking:
    """Ranks of one group under the usual convention, with their uncertainty."""

    group: ComparisonGroup
    draws: Array  #: (draws, solvers) means over resampled cases, s

    @cached_property
    def means(self) -> Array:
        """(solvers,) shifted geometric means, s."""
        return geometric_means(self.group, USUAL)

    @cached_property
    def order(self) -> NDArray[np.int64]:
        """Solvers from the smallest mean to the largest; equals as in the suite."""
        return np.argsort(self.means, kind="stable")

    @property
    def leader(self) -> int:
        """The solver with the smallest mean."""
        return int(self.order[0])

    @cached_property
    def intervals(self) -> tuple[Array, Array]:
        """95 % intervals of the means, s."""
        return resampling.limits(self.draws, len(self.group.cases))

    @cached_property
    def ratios(self) -> tuple[Array, Array, Array]:
        """Mean over that of the leader, on the same cases, and its 95 % interval."""
        draws = self.draws / self.draws[:, [self.leader]]
        low, high = resampling.limits(draws, len(self.group.cases))
        return self.means / self.means[self.leader], low, high

    @cached_property
    def first(self) -> Array:
        """(solvers,) share of the resamples in which the solver has the least mean."""
        return resampling.firsts(np.log(self.draws))

    @cached_property
    def faster(self) -> NDArray[np.bool_]:
        """(solvers, solvers) whether row is told to be faster than column."""
        logs, _ = _logs(self.group, USUAL)
        faster = resampling.told_apart(logs, self.group.cases)
        if self.group.apart.any():  # of different sessions: no pairs
            faster = np.where(self.group.apart, self.group.faster, faster)
        return faster

    @cached_property
    def spans(self) -> list[tuple[int, int]]:
        """Ranks that a solver may have: after all told faster, before all told slower.

        Together these hold the true ranks with 95 % [1]_.

        References
        ----------
        .. [1] M. Mogstad, J. P. Romano, A. M. Shaikh, D. Wilhelm, Inference for Ranks,
           Review of Economic Studies 91 (2024) 476-518

        """
        behind, ahead = self.faster.sum(axis=0), self.faster.sum(axis=1)
        last = len(self.group.solvers)
        return [(1 + int(b), last - int(a)) for b, a in zip(behind, ahead, strict=True)]

    @cached_property
    def tiers(self) -> NDArray[np.int64]:
        """(solvers,) tier from 1: the first whose head is not told to be faster.

        The leader heads the first tier, and who fits into none heads the next. A mean
        that is known badly, as it is with failures, may be in an earlier tier than a
        smaller one.
        """
        tiers = np.zeros(len(self.group.solvers), dtype=np.int64)
        heads: list[int] = []
        for solver in self.order:
            fits = [n for n, head in enumerate(heads) if not self.faster[head, solver]]
            if not fits:
                heads.append(int(solver))
            tiers[solver] = 1 + (fits[0] if fits else len(heads) - 1)
        return tiers


def ranking_of(group: ComparisonGroup) -> Ranking:
    """Rank the solvers of a group, resampling its cases."""
    logs, shift = _logs(group, USUAL)
    draws = np.exp(resampling.weights(group.cases) @ logs) - shift
    return Ranking(group=group, draws=draws)


class Changed(NamedTuple):
    """Ranks under another convention."""

    ranks: Array  #: (solvers,) from 1, equal means have equal ranks; NaN: not compared
    turned: NDArray[np.bool_]  #: (solvers, solvers) whether it turns their order


class Panel(NamedTuple):
    """Ranks of the solvers of a group under every convention."""

    usual: Array  #: (solvers,)
    single: dict[str, Changed]  #: by the one thing that was changed
    every: tuple[Changed, ...]

    @property
    def turned(self) -> NDArray[np.bool_]:
        """(solvers, solvers) whether any convention turns the usual order."""
        changes = (*self.every, *self.single.values())
        return np.asarray(np.logical_or.reduce([c.turned for c in changes]))


def panel(group: ComparisonGroup) -> Panel:
    """Rank under the usual convention, with one thing changed, and with all."""
    usual = geometric_means(group, USUAL)

    def changed(convention: Convention) -> Changed:
        means = geometric_means(group, convention)
        return Changed(ranks(means), order_of(usual) * order_of(means) < 0)

    return Panel(
        usual=ranks(usual),
        single={name: changed(convention) for name, convention in SINGLE.items()},
        every=tuple(map(changed, EVERY)),
    )


def ranks(means: Array) -> Array:
    """Rank from 1; means that are equal but for rounding share the smaller rank."""
    ahead = (order_of(means) > 0).sum(axis=1)  # of how many others one is behind
    return np.where(np.isnan(means), np.nan, 1.0 + ahead)


def order_of(means: Array) -> NDArray[np.int64]:
    """(solvers, solvers) 1 where row is slower than column, −1 faster, else 0."""
    logs = np.log(means)
    gap = logs[:, None] - logs[None, :]
    return np.where(np.abs(gap) > _SAME, np.sign(gap), 0).astype(np.int64)
