"""How far ranks depend on conventions, and how far they are inside the noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reports.data.aggregation import (
    EVERY,
    PENALTIES,
    SHIFTS,
    SINGLE,
    USUAL,
    Array,
    Convention,
    Ranking,
    geometric_means,
)
from reports.data.comparison_groups import ComparisonGroup
from reports.document.formatting import ABSENT, plural
from reports.document.layout import Cell, Section, Table, name_cell
from reports.sections.means import described

_SAME = 1e-12  #: relative difference of means that are equal but for rounding


class Changed(NamedTuple):
    """What becomes of the ranks under another convention."""

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


def ranking(rankings: Sequence[Ranking]) -> Section | None:
    """Tabulate the panel of every group; None where there is none."""
    if not rankings:
        return None
    panels = [(ranking, panel(ranking.group)) for ranking in rankings]
    return Section(
        name="ranking",
        title="What ranks depend on",
        prose=(
            "Ranks by the means above, and what becomes of them when one convention is "
            f"changed: the shift ({_listed(SHIFTS)} times the fitted one), the limits "
            f"charged for an unsolved case ({_listed(PENALTIES)}), whether the "
            "solver's claim is taken for a solution, or only cases that all solved. "
            f"All: the ranks under the {len(EVERY)} combinations of shift, penalty and "
            "gate. Emphasised: the order to some other solver is turned.",
            "Inside the noise: from the number of solvers told faster, plus one, to "
            "that of all but those told slower; together these ranges hold the true "
            "ranks of all solvers with 95 %. Where a range is longer than one rank, "
            "the rank is inside the noise.",
        ),
        points=tuple(_verdict(*each) for each in panels),
        tables=tuple(_table(*each) for each in panels),
    )


def _listed(values: Sequence[float]) -> str:
    return ", ".join(f"{v:g}" for v in values)


def _verdict(ranking: Ranking, ranked: Panel) -> str:
    """Say in a sentence what the ranking of one group is worth."""
    upper = np.triu(np.ones_like(ranked.turned), 1)
    told = (ranking.faster | ranking.faster.T) & upper
    turned = ranked.turned & upper
    n = len(ranking.group.solvers)
    turns = (
        f"conventions turn the order of {turned.sum()}, among them "
        f"{(turned & told).sum()} that are told apart"
        if turned.any()
        else "no convention turns an order"
    )
    return (
        f"{ranking.group.title}: {plural(n, 'solver')} in "
        f"{plural(int(ranking.tiers.max()), 'tier')}; of "
        f"{plural(n * (n - 1) // 2, 'pair')} {told.sum()} told apart; {turns}."
    )


def _table(ranking: Ranking, ranked: Panel) -> Table:
    return Table(
        caption=f"Ranks under changed conventions, {described(ranking.group)} "
        f"Usual: {USUAL.penalty:g} limits for an unsolved case, verified answers.",
        columns=(
            "solver", "tier", "rank", "inside the noise", *ranked.single, "all",
            "reading",
        ),
        rows=tuple(_row(ranking, ranked, int(i)) for i in ranking.order),
    )  # fmt: skip


def _row(ranking: Ranking, ranked: Panel, i: int) -> tuple[Cell, ...]:
    tier, rank = int(ranking.tiers[i]), int(ranked.usual[i])
    low, high = ranking.spans[i]
    every = [int(changed.ranks[i]) for changed in ranked.every]
    told = ranking.faster[i] | ranking.faster[:, i]
    return (
        name_cell(ranking.group.solvers[i]),
        Cell(text=str(tier), value=tier),
        Cell(text=str(rank), value=rank),
        Cell(text=_range(low, high), value=low),
        *(_changed(changed, i) for changed in ranked.single.values()),
        Cell(text=_range(min(every), max(every)), value=min(every)),
        Cell(text=_reading(ranked.turned[i], told, sure=low == high), kind="words"),
    )


def _changed(changed: Changed, i: int) -> Cell:
    rank = changed.ranks[i]
    if np.isnan(rank):
        return Cell(text=ABSENT, title="takes no part in the comparison")
    kind = "over" if changed.turned[i].any() else ""
    return Cell(text=str(int(rank)), value=float(rank), kind=kind)


def _reading(turned: NDArray[np.bool_], told: NDArray[np.bool_], *, sure: bool) -> str:
    """Say what the rank of a solver is worth; sure: it can have no other."""
    if (turned & told).any():
        return "depends on the convention"
    if turned.any():
        return "turns inside the noise"
    return "the same under all" if sure else "the same under all, inside the noise"


def _range(low: int, high: int) -> str:
    return str(low) if low == high else f"{low}–{high}"
