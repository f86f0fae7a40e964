"""Means of times over cases, with what another draw of cases would have said."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.pairs import paired_ratio
from reports.data.aggregation import USUAL, Convention, Standing, common_cases
from reports.data.aggregation import geometric_means as means_by
from reports.data.comparison_groups import CASES, LARGEST_SHIFT, Contest
from reports.document.formatting import (
    ABSENT,
    TIMED,
    bracketed,
    plural,
    seconds,
    significant,
)
from reports.document.layout import Cell, Section, Table, name_cell
from reports.statistics.censoring import restricted_mean
from reports.statistics.intervals import COVERAGE, Interval

_COLUMNS = (
    "solver", "tier", "solved", "mean", "to the leader", "P(best)",
    "both solved, to the leader", "common cases, to the leader", "mean up to the limit",
)  # fmt: skip


def means(standings: Sequence[Standing]) -> Section | None:
    """Tabulate the means of every contest; None where there is none."""
    if not standings:
        return None
    return Section(
        name="means",
        title="Means over cases",
        prose=(
            "Shifted geometric means exp(mean log(t + s)) − s of the median times of "
            "verified answers, one time per case. The shift s is the median over the "
            f"cases of the best time (at most {LARGEST_SHIFT:g} s): a fixed one of "
            "seconds would make the mean of milliseconds an arithmetic one. An "
            f"unsolved case is charged {USUAL.penalty:g} limits; next to that stand "
            "two comparisons that charge nothing, and the arithmetic mean of times cut "
            "at the limit. Forms are compared apart, "
            f"and only where there are at least {CASES} cases.",
            "Intervals (95 %) are over the cases: they say what other cases of the "
            "same kind might have given. A solver is in the first tier whose head "
            "these cases do not tell to be faster: within a tier, ranks are inside the "
            "noise. "
            "What is told apart is so with 95 % for all pairs at once. P(best) is the "
            "share of resampled sets of cases in which a solver has the least mean. "
            "Formulas, sources and limits are in docs/statistics.md.",
        ),
        tables=tuple(map(_table, standings)),
    )


def described(contest: Contest) -> str:
    """Name a contest with the numbers that its means depend on."""
    return (
        f"{contest.title}: {plural(len(contest.cases), 'case')}, shift "
        f"{significant(contest.shift)} s, limit {significant(contest.limit)} s."
    )


def _table(standing: Standing) -> Table:
    contest = standing.contest
    rows, columns = common_cases(contest)
    left = [s for s, used in zip(contest.solvers, columns, strict=True) if not used]
    common = f"Common cases: {rows.sum()}, solved by all"
    common += (
        f" but {plural(len(left), 'solver')} with less than half solved."
        if left
        else "."
    )
    return Table(
        caption=f"Times over cases, {described(contest)} {common} Both solved: "
        "geometric mean of the ratios on cases that the solver and the leader solved.",
        notes=(*contest.notes, TIMED),
        columns=_COLUMNS,
        rows=tuple(_row(standing, int(i)) for i in standing.order),
    )


def _row(standing: Standing, i: int) -> tuple[Cell, ...]:
    contest, leads = standing.contest, i == standing.leader
    solved = int(contest.solved[:, i].sum())
    tier = int(standing.tiers[i])
    return (
        name_cell(contest.solvers[i]),
        Cell(text=str(tier), value=tier),
        Cell(text=f"{solved} of {len(contest.cases)}", value=solved),
        _mean(standing, i) if solved else Cell(text="none solved", kind="quiet"),
        _ratio(standing, i),
        Cell(text=_share(float(standing.first[i])), value=float(standing.first[i])),
        Cell(text="1") if leads else _pairs(contest, i, standing.leader),
        _common(standing, i),
        _restricted(contest, i) if solved else Cell(text="none solved", kind="quiet"),
    )


def _mean(standing: Standing, i: int) -> Cell:
    value = float(standing.means[i])
    low, high = (float(end[i]) for end in standing.intervals)
    mean = Interval(value, low, high, COVERAGE, len(standing.contest.cases))
    kind = "best" if i == standing.leader else ""
    return Cell(text=seconds(mean), value=value, kind=kind)


def _ratio(standing: Standing, i: int) -> Cell:
    value, low, high = (float(part[i]) for part in standing.ratios)
    if i == standing.leader:
        return Cell(text="1", value=1.0)
    return Cell(text=bracketed(value, low, high), value=value)


def _share(p: float) -> str:
    """Print a share of the draws without claiming what they cannot show."""
    return "0" if p == 0 else "< 0.01" if p < 0.01 else f"{p:.2f}"


def _pairs(contest: Contest, i: int, leader: int) -> Cell:
    """Compare with the leader on the cases that both solved; nothing is charged."""
    mine, its = (
        {p: float(t) for p, t in enumerate(contest.times[:, s]) if np.isfinite(t)}
        for s in (i, leader)
    )
    ratio = paired_ratio(mine, its)
    if ratio is None or ratio.pairs < CASES:
        return Cell(text=ABSENT, title=f"fewer than {CASES} cases that both solved")
    return Cell(
        text=bracketed(ratio.value, ratio.low, ratio.high),
        after=f"n = {ratio.pairs}",
        value=ratio.value,
    )


def _common(standing: Standing, i: int) -> Cell:
    """Ratio to the leader where all solved."""
    found = means_by(standing.contest, Convention(common=True))
    value = float(found[i] / found[standing.leader])
    if np.isnan(value):
        return Cell(text=ABSENT, title="too few cases that all solved")
    return Cell(text=significant(value), value=value)


def _restricted(contest: Contest, i: int) -> Cell:
    """Mean of the times cut at the limit, with what is censored."""
    found = restricted_mean(contest.times[:, i], contest.stopped[:, i], contest.horizon)
    known = [
        f"{count} {what}"
        for count, what in ((found.stopped, "out of time"), (found.never, "never"))
        if count
    ]
    return Cell(
        text=seconds(found.mean), after=", ".join(known), value=found.mean.value
    )
