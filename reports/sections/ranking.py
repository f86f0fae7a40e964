"""Times over cases: means, rankings under several conventions, and profiles."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

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
    geometric_means,
    panel,
)
from mortarbench.reports.data.comparison_groups import (
    CASES,
    LARGEST_SHIFT,
    ComparisonGroup,
)
from mortarbench.reports.document.formatting import TIMED, estimate, fixed, significant
from mortarbench.reports.document.layout import Cell, Part, Picture, Table
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.figures.profiles import (
    banded,
    pairwise_figure,
    profile_figure,
    rivals,
    rows_of,
)
from mortarbench.reports.sections import Analysis, section
from mortarbench.reports.statistics.censoring import restricted_mean
from mortarbench.reports.statistics.intervals import COVERAGE, Interval
from mortarbench.reports.statistics.profiles import performance_ratios, solved_within

DRAWN = 4  #: largest number of groups whose profiles are drawn; all are tabulated
#: multiples of the best time; columns of the table of profiles
FACTORS = (1.0, 2.0, 5.0, 10.0)
TEXT = Sentences(
    __name__,
    CASES=CASES,
    EVERY=EVERY,
    LARGEST_SHIFT=LARGEST_SHIFT,
    PENALTIES=PENALTIES,
    SHIFTS=SHIFTS,
    USUAL=USUAL,
)


def not_compared(a: Analysis, *, reasons: bool = False) -> list[str]:
    """List the groups that are not compared over cases.

    reasons : True to state the reasons, False to refer to the section that states them
    """
    lacking = [group for group in a.groups if not group.comparable]
    if not lacking:
        return []
    if not reasons:
        return TEXT.parts("not_repeated", a.groups, lacking)
    poolable = (
        not a.pool_forms
        and len(a.pooled) < len(a.groups)
        and any(group.comparable for group in a.pooled)
    )
    return TEXT.parts("not_compared", a.groups, lacking, poolable)


@section(40, "means", "Means over cases")
def means(a: Analysis) -> Iterator[Part]:
    """Tabulate the means of every ranked group, and name the other groups."""
    if a.rankings:
        yield from TEXT.parts("means", any(r.group.forms for r in a.rankings))
    yield from not_compared(a, reasons=True)
    yield from map(_means_table, a.rankings)


def _means_table(ranking: Ranking) -> Table:
    group, leader = ranking.group, ranking.leader
    rows, columns = common_cases(group)
    common = geometric_means(group, Convention(common=True))
    solved = group.solved.sum(axis=0)
    nothing = Cell(text="none solved", kind="quiet")

    def mean(i: int) -> Cell:
        low, high = (float(end[i]) for end in ranking.intervals)
        value = Interval(float(ranking.means[i]), low, high, COVERAGE, len(group.cases))
        return Cell.time(value, kind="best" if i == leader else "")

    def ratio(i: int) -> Cell:
        found = [float(part[i]) for part in ranking.ratios]
        return Cell(text="1" if i == leader else estimate(found), value=found[0])

    def common_ratio(i: int) -> Cell:
        value = float(common[i] / common[leader])
        if np.isnan(value):
            return Cell(title="solved too few cases, or too few common cases")
        return Cell.number(value, significant)

    def restricted(i: int) -> Cell:
        censored_mean = restricted_mean(
            group.times[:, i], group.stopped[:, i], group.horizon
        )
        censored = [f"{censored_mean.stopped} out of time"] * bool(
            censored_mean.stopped
        )
        censored += [f"{censored_mean.never} never"] * bool(censored_mean.never)
        return Cell.time(censored_mean.mean, after=", ".join(censored))

    return Table.of(
        TEXT("means_caption", group, rows.sum(), (~columns).sum()),
        map(int, ranking.order),
        (
            ("solver", lambda i: Cell.name(group.solvers[i])),
            ("tier", lambda i: Cell.number(int(ranking.tiers[i]))),
            (
                "solved",
                lambda i: Cell(
                    text=f"{solved[i]} of {len(group.cases)}", value=solved[i]
                ),
            ),
            ("mean", lambda i: mean(i) if solved[i] else nothing),
            ("to the leader", ratio),
            ("P(best)", lambda i: Cell.number(float(ranking.first[i]), _share)),
            (
                "both solved, to the leader",
                lambda i: Cell(text="1") if i == leader else _pairs(group, i, leader),
            ),
            ("common cases, to the leader", common_ratio),
            ("mean up to the limit", lambda i: restricted(i) if solved[i] else nothing),
        ),
        notes=(*group.notes, TIMED),
    )


def _share(p: float) -> str:
    """Format a share of the draws with as many digits as 2000 draws support."""
    return "0" if p == 0 else "< 0.01" if p < 0.01 else f"{p:.2f}"


def _pairs(group: ComparisonGroup, i: int, leader: int) -> Cell:
    """Return a solver's ratio to the leader on the cases that both of them solved."""
    mine, its = (
        {p: float(t) for p, t in enumerate(group.times[:, s]) if np.isfinite(t)}
        for s in (i, leader)
    )
    ratio = paired_ratio(mine, its)
    if ratio is None or ratio.pairs < CASES:
        return Cell(title=f"fewer than {CASES} cases solved by both")
    session = ", other session" * bool(group.apart.any() and group.apart[i, leader])
    return Cell.ratio(ratio, after=f"n = {ratio.pairs}{session}")


@section(42, "ranking", "Dependence of the ranking on conventions")
def ranking(a: Analysis) -> Iterator[Part]:
    """Tabulate the ranking of every ranked group under changed conventions."""
    if a.rankings:
        yield from TEXT.parts("ranking")
    yield from not_compared(a)
    for one in a.rankings:
        ranked = panel(one.group)
        upper = np.triu(np.ones_like(ranked.turned), 1)
        separated = (one.faster | one.faster.T) & upper
        turned = ranked.turned & upper
        both = turned & separated
        counts = int(one.tiers.max()), separated.sum(), turned.sum(), both.sum()
        yield from TEXT.parts("order", one.group, *counts)
        yield _panel_table(one, ranked)


def _panel_table(ranking: Ranking, ranked: Panel) -> Table:
    def changed(one: Changed, i: int) -> Cell:
        if np.isnan(one.ranking[i]):
            return Cell(title="not part of this comparison")
        return Cell.number(
            float(one.ranking[i]),
            "{:.0f}".format,
            kind="over" if one.turned[i].any() else "",
        )

    def every(i: int) -> Cell:
        found = [int(one.ranking[i]) for one in ranked.every]
        return _range(min(found), max(found))

    def reading(i: int) -> Cell:
        separated = ranking.faster[i] | ranking.faster[:, i]
        low, high = ranking.spans[i]
        return Cell.words(_reading(ranked.turned[i], separated, unique=low == high))

    return Table.of(
        TEXT("panel_caption", ranking.group),
        map(int, ranking.order),
        (
            ("solver", lambda i: Cell.name(ranking.group.solvers[i])),
            ("tier", lambda i: Cell.number(int(ranking.tiers[i]))),
            ("rank", lambda i: Cell.number(int(ranked.usual[i]))),
            ("rank interval", lambda i: _range(*ranking.spans[i])),
            *((name, partial(changed, one)) for name, one in ranked.single.items()),
            ("all", every),
            ("reading", reading),
        ),
    )


def _reading(
    turned: NDArray[np.bool_], separated: NDArray[np.bool_], *, unique: bool
) -> str:
    """Describe the reliability of the rank of one solver.

    turned : (solvers,) True if some convention reverses the order with that solver
    separated : (solvers,) True if the difference from that solver is significant
    unique : True if the rank interval is a single rank
    """
    if (turned & separated).any():
        return "depends on the convention"
    if turned.any():
        return "reversed, not significantly"
    robust = "same under all conventions"
    return robust if unique else f"{robust}, not significant"


def _range(low: int, high: int) -> Cell:
    return Cell(text=str(low) if low == high else f"{low}–{high}", value=low)


@section(44, "profiles", "Profiles")
def profiles(a: Analysis) -> Iterator[Part]:
    """Tabulate the profiles of every ranked group; draw those of the first `DRAWN`."""
    if a.rankings:
        yield from TEXT.parts("profiles", len(a.rankings), DRAWN)
    yield from not_compared(a)
    yield from map(_profile_table, a.rankings)
    solvers = a.evidence.solvers
    for k, ranking in enumerate(a.rankings[:DRAWN], 1):
        rows = rows_of(ranking, solvers)
        slower = len(ranking.group.solvers) - sum(map(len, rows))
        yield Picture(
            name=f"profiles-{k}",
            caption=TEXT("drawn", ranking.group, len(rows), slower, banded(ranking)),
            figure=profile_figure(ranking, solvers),
        )
        if len(ranking.group.solvers) > 2:
            yield Picture(
                name=f"pairwise-{k}",
                caption=TEXT("pairwise", ranking, len(rivals(ranking))),
                figure=pairwise_figure(ranking, solvers),
            )


def _profile_table(ranking: Ranking) -> Table:
    group = ranking.group
    ratios = performance_ratios(group.times)
    within = (*FACTORS, np.finfo(float).max)
    heads = ("best", *(f"within {f:g} ×" for f in FACTORS[1:]), "at all")
    shares = [list(zip(*solved_within(of, within), strict=True)) for of in ratios.T]

    def share(k: int, i: int) -> Cell:
        return Cell(text=fixed(shares[i][k], 2), value=float(shares[i][k][0]))

    return Table.of(
        TEXT("shares_caption", group, int((~group.solved.any(axis=1)).sum())),
        map(int, ranking.order),
        (
            ("solver", lambda i: Cell.name(group.solvers[i])),
            *((head, partial(share, k)) for k, head in enumerate(heads)),
        ),
    )
