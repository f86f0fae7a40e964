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
    """Choices in the averaging of times over cases."""

    shift: float = 1.0  #: shift of times, in units of the shift of the group
    penalty: float = 3.0  #: charge for an unsolved case, in units of `horizon`
    #: answers that count as solved: "verified", or "claimed" to be solved by the solver
    gate: str = "verified"
    common: bool = False  #: use only the cases of `common_cases`


USUAL = Convention()  #: convention used for tiers and ratios

#: Conventions that differ from `USUAL` in one choice, by the heading of their column.
SINGLE = {
    "shift × 0.01": replace(USUAL, shift=0.01),
    "shift × 10": replace(USUAL, shift=10.0),
    "1 limit": replace(USUAL, penalty=1.0),
    "10 limits": replace(USUAL, penalty=10.0),
    "claimed": replace(USUAL, gate="claimed"),
    "common": replace(USUAL, common=True),
}

_SAME = 1e-12  #: smaller relative differences between means count as rounding

#: Every combination of shift, penalty and gate.
EVERY = tuple(
    Convention(shift=s, penalty=p, gate=g)
    for s, p, g in product(SHIFTS, PENALTIES, GATES)
)


def geometric_means(group: ComparisonGroup, convention: Convention) -> Array:
    """Return shifted geometric means of times over cases, s, (solvers,).

    The mean of times t is exp(mean log(t + shift)) − shift. An unsolved case counts as
    `penalty` times the `horizon` of the group. With `common`, only the cases of
    `common_cases` are averaged, and the entries of excluded solvers are NaN; with fewer
    than `CASES` such cases, all entries are NaN.
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
    """Return the cases solved by every solver that solved at least half of all cases.

    A solver that solved only a few cases would leave almost no common cases.

    Returns
    -------
    cases, solvers : boolean masks

    """
    solvers = group.solved.mean(axis=0) >= 0.5
    cases = np.logical_and.reduce(group.solved[:, solvers], axis=1)
    return np.asarray(cases), np.asarray(solvers)


def _logs(group: ComparisonGroup, convention: Convention) -> tuple[Array, float]:
    """Return log(time + shift), (cases, solvers), and the shift in seconds."""
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
        """Indices of solvers by ascending mean; ties keep the order of the solvers."""
        return np.argsort(self.means, kind="stable")

    @property
    def leader(self) -> int:
        """Index of the solver with the smallest mean."""
        return int(self.order[0])

    @cached_property
    def intervals(self) -> tuple[Array, Array]:
        """95 % intervals of the means, s."""
        return resampling.limits(self.draws, len(self.group.cases))

    @cached_property
    def ratios(self) -> tuple[Array, Array, Array]:
        """Means relative to the leader, on the same cases, with 95 % intervals."""
        draws = self.draws / self.draws[:, [self.leader]]
        low, high = resampling.limits(draws, len(self.group.cases))
        return self.means / self.means[self.leader], low, high

    @cached_property
    def first(self) -> Array:
        """(solvers,) share of the resamples in which each solver has the least mean."""
        return resampling.firsts(np.log(self.draws))

    @cached_property
    def faster(self) -> NDArray[np.bool_]:
        """(solvers, solvers) True where row is significantly faster than column."""
        logs, _ = _logs(self.group, USUAL)
        faster = resampling.significantly_faster(logs, self.group.cases)
        if self.group.apart.any():  # different sessions have no common blocks to pair
            faster = np.where(self.group.apart, self.group.faster, faster)
        return faster

    @cached_property
    def spans(self) -> list[tuple[int, int]]:
        """Intervals of the ranking that significant differences between solvers allow.

        A solver comes after all significantly faster solvers and before all
        significantly slower ones. The intervals contain the true ranking jointly with
        95 % confidence [1]_.

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
        """Tiers of the solvers, numbered from 1, (solvers,).

        The leader heads the first tier. Each solver joins the first tier whose head is
        not significantly faster; if there is no such tier, it heads a new one. A solver
        whose mean is uncertain because of failures may thus be in an earlier tier than
        a solver with a smaller mean.
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
    """Rank the solvers of a group, with draws over resampled cases."""
    logs, shift = _logs(group, USUAL)
    draws = np.exp(resampling.weights(group.cases) @ logs) - shift
    return Ranking(group=group, draws=draws)


class Changed(NamedTuple):
    """Ranks under another convention."""

    #: (solvers,) from 1, equal means have equal numbers; NaN: not compared
    ranking: Array
    #: (solvers, solvers) True if the order of the row and column solvers is reversed
    turned: NDArray[np.bool_]


class Panel(NamedTuple):
    """Ranks of the solvers of a group under every convention."""

    usual: Array  #: (solvers,)
    single: dict[str, Changed]  #: one choice changed, by its name
    every: tuple[Changed, ...]  #: all combinations of shift, penalty and gate

    @property
    def turned(self) -> NDArray[np.bool_]:
        """(solvers, solvers) True if some convention reverses the usual order."""
        changes = (*self.every, *self.single.values())
        return np.asarray(np.logical_or.reduce([c.turned for c in changes]))


def panel(group: ComparisonGroup) -> Panel:
    """Rank solvers under the usual convention, single changes and all combinations."""
    usual = geometric_means(group, USUAL)

    def changed(convention: Convention) -> Changed:
        means = geometric_means(group, convention)
        return Changed(rank_of(means), order_of(usual) * order_of(means) < 0)

    return Panel(
        usual=rank_of(usual),
        single={name: changed(convention) for name, convention in SINGLE.items()},
        every=tuple(map(changed, EVERY)),
    )


def rank_of(means: Array) -> Array:
    """Rank means from 1; means that are equal up to rounding share the smaller rank."""
    ahead = (order_of(means) > 0).sum(axis=1)  # number of solvers with smaller means
    return np.where(np.isnan(means), np.nan, 1.0 + ahead)


def order_of(means: Array) -> NDArray[np.int64]:
    """Compare means pairwise, (solvers, solvers): 1: row slower, −1: row faster.

    The entry is 0 if the means are equal up to rounding, or if one of them is NaN.
    """
    logs = np.log(means)
    gap = logs[:, None] - logs[None, :]
    return np.where(np.abs(gap) > _SAME, np.sign(gap), 0).astype(np.int64)
