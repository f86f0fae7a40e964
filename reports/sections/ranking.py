"""Times over cases: means, ranks, and what they depend on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.running.pairs import paired_ratio
from mortarbench.reports.data.aggregation import (
    EVERY,
    PENALTIES,
    SHIFTS,
    USUAL,
    Changed,
    Convention,
    Panel,
    Ranking,
    common_cases,
    panel,
)
from mortarbench.reports.data.aggregation import geometric_means as means_by
from mortarbench.reports.data.comparison_groups import (
    CASES,
    LARGEST_SHIFT,
    ComparisonGroup,
)
from mortarbench.reports.document.formatting import (
    ABSENT,
    TIMED,
    bracketed,
    plural,
    seconds,
    significant,
)
from mortarbench.reports.document.layout import Cell, Section, Table, name_cell
from mortarbench.reports.statistics.censoring import restricted_mean
from mortarbench.reports.statistics.intervals import COVERAGE, Interval

_LACKING = 6  #: groups that are named as not compared
_COLUMNS = (
    "solver", "tier", "solved", "mean", "to the leader", "P(best)",
    "both solved, to the leader", "common cases, to the leader", "mean up to the limit",
)  # fmt: skip


def left_out(groups: Sequence[ComparisonGroup], *, poolable: bool) -> tuple[str, ...]:
    """Say of which groups nothing is said over cases, and what they lack.

    Empty where every group is comparable.

    poolable : whether all forms together would make a group that is
    """
    lacking = [group for group in groups if not group.comparable]
    if not lacking:
        return ()
    some = len(lacking) < len(groups)
    counted = [f"{group.title}: {group.lack}" for group in lacking[:_LACKING]]
    counted += [f"and {len(lacking) - _LACKING} more"] * (len(lacking) > _LACKING)
    one_of = "" if any(group.forms for group in groups) else " of one form"
    text = (
        f"{'Not compared here' if some else 'Nothing is compared here'}: "
        f"{'; '.join(counted)}. At least {CASES} cases{one_of} at one accuracy are "
        "needed, two solvers that were measured on them, and a verified answer: with "
        "fewer cases no two solvers can be told apart."
    )
    hint = (
        ' "mortarbench report DIR --pool-forms" puts the cases of all forms together.'
    )
    return (text + hint * poolable,)


def means(rankings: Sequence[Ranking], left: tuple[str, ...] = ()) -> Section:
    """Tabulate the means of every group.

    left : what `left_out` says
    """
    name, title = "means", "Means over cases"
    if not rankings:
        return Section(name=name, title=title, prose=left)
    return Section(
        name=name,
        title=title,
        prose=(
            "Shifted geometric means exp(mean log(t + s)) − s of the median times of "
            "verified answers, one time per case. The shift s is the median over the "
            f"cases of the best time (at most {LARGEST_SHIFT:g} s): a fixed one of "
            "seconds would make the mean of milliseconds an arithmetic one. An "
            f"unsolved case is charged {USUAL.penalty:g} limits; next to that stand "
            "two comparisons that charge nothing, and the arithmetic mean of times cut "
            "at the limit. "
            + (
                "Forms are compared together, as asked for."
                if any(ranking.group.forms for ranking in rankings)
                else "Forms are compared apart, "
                f"and only where there are at least {CASES} cases."
            ),
            "Intervals (95 %) are over the cases: they say what other cases of the "
            "same kind might have given. A solver is in the first tier whose head "
            "these cases do not tell to be faster: within a tier, ranks are inside the "
            "noise. "
            "What is told apart is so with 95 % for all pairs at once. P(best) is the "
            "share of resampled sets of cases in which a solver has the least mean. "
            "Formulas, sources and limits are in docs/statistics.md.",
            *left,
        ),
        tables=tuple(map(_table, rankings)),
    )


def described(group: ComparisonGroup) -> str:
    """Name a group of cases with the numbers that its means depend on."""
    return (
        f"{group.title}: {plural(len(group.cases), 'case')}, shift "
        f"{significant(group.shift)} s, limit {significant(group.limit)} s."
    )


def _table(ranking: Ranking) -> Table:
    group = ranking.group
    rows, columns = common_cases(group)
    left = [s for s, used in zip(group.solvers, columns, strict=True) if not used]
    common = f"Common cases: {rows.sum()}, solved by all"
    common += (
        f" but {plural(len(left), 'solver')} with less than half solved."
        if left
        else "."
    )
    return Table(
        caption=f"Times over cases, {described(group)} {common} Both solved: "
        "geometric mean of the ratios on cases that the solver and the leader solved.",
        notes=(*group.notes, TIMED),
        columns=_COLUMNS,
        rows=tuple(_row(ranking, int(i)) for i in ranking.order),
    )


def _row(ranking: Ranking, i: int) -> tuple[Cell, ...]:
    group, leads = ranking.group, i == ranking.leader
    solved = int(group.solved[:, i].sum())
    tier = int(ranking.tiers[i])
    return (
        name_cell(group.solvers[i]),
        Cell(text=str(tier), value=tier),
        Cell(text=f"{solved} of {len(group.cases)}", value=solved),
        _mean(ranking, i) if solved else Cell(text="none solved", kind="quiet"),
        _ratio(ranking, i),
        Cell(text=_share(float(ranking.first[i])), value=float(ranking.first[i])),
        Cell(text="1") if leads else _pairs(group, i, ranking.leader),
        _common(ranking, i),
        _restricted(group, i) if solved else Cell(text="none solved", kind="quiet"),
    )


def _mean(ranking: Ranking, i: int) -> Cell:
    value = float(ranking.means[i])
    low, high = (float(end[i]) for end in ranking.intervals)
    mean = Interval(value, low, high, COVERAGE, len(ranking.group.cases))
    kind = "best" if i == ranking.leader else ""
    return Cell(text=seconds(mean), value=value, kind=kind)


def _ratio(ranking: Ranking, i: int) -> Cell:
    value, low, high = (float(part[i]) for part in ranking.ratios)
    if i == ranking.leader:
        return Cell(text="1", value=1.0)
    return Cell(text=bracketed(value, low, high), value=value)


def _share(p: float) -> str:
    """Print a share of the draws without claiming what they cannot show."""
    return "0" if p == 0 else "< 0.01" if p < 0.01 else f"{p:.2f}"


def _pairs(group: ComparisonGroup, i: int, leader: int) -> Cell:
    """Compare with the leader on the cases that both solved; nothing is charged."""
    mine, its = (
        {p: float(t) for p, t in enumerate(group.times[:, s]) if np.isfinite(t)}
        for s in (i, leader)
    )
    ratio = paired_ratio(mine, its)
    if ratio is None or ratio.pairs < CASES:
        return Cell(text=ABSENT, title=f"fewer than {CASES} cases that both solved")
    return Cell(
        text=bracketed(ratio.value, ratio.low, ratio.high),
        after=f"n = {ratio.pairs}{_session(group, i, leader)}",
        value=ratio.value,
    )


def _session(group: ComparisonGroup, i: int, j: int) -> str:
    """Mark two solvers that were not measured within the same blocks."""
    return ", other session" if group.apart.any() and group.apart[i, j] else ""


def _common(ranking: Ranking, i: int) -> Cell:
    """Ratio to the leader where all solved."""
    found = means_by(ranking.group, Convention(common=True))
    value = float(found[i] / found[ranking.leader])
    if np.isnan(value):
        return Cell(text=ABSENT, title="too few cases that all solved")
    return Cell(text=significant(value), value=value)


def _restricted(group: ComparisonGroup, i: int) -> Cell:
    """Mean of the times cut at the limit, with what is censored."""
    found = restricted_mean(group.times[:, i], group.stopped[:, i], group.horizon)
    known = [
        f"{count} {what}"
        for count, what in ((found.stopped, "out of time"), (found.never, "never"))
        if count
    ]
    return Cell(
        text=seconds(found.mean), after=", ".join(known), value=found.mean.value
    )


def ranking(rankings: Sequence[Ranking], left: tuple[str, ...] = ()) -> Section:
    """Tabulate the panel of every group.

    left : what `left_out` says
    """
    name, title = "ranking", "What ranks depend on"
    if not rankings:
        return Section(name=name, title=title, prose=left)
    panels = [(ranking, panel(ranking.group)) for ranking in rankings]
    return Section(
        name=name,
        title=title,
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
            *left,
        ),
        points=tuple(_worth(*each) for each in panels),
        tables=tuple(_panel_table(*each) for each in panels),
    )


def _listed(values: Sequence[float]) -> str:
    return ", ".join(f"{v:g}" for v in values)


def _worth(ranking: Ranking, ranked: Panel) -> str:
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


def _panel_table(ranking: Ranking, ranked: Panel) -> Table:
    return Table(
        caption=f"Ranks under changed conventions, {described(ranking.group)} "
        f"Usual: {USUAL.penalty:g} limits for an unsolved case, verified answers.",
        columns=(
            "solver", "tier", "rank", "inside the noise", *ranked.single, "all",
            "reading",
        ),
        rows=tuple(_panel_row(ranking, ranked, int(i)) for i in ranking.order),
    )  # fmt: skip


def _panel_row(ranking: Ranking, ranked: Panel, i: int) -> tuple[Cell, ...]:
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
