"""The section on profiles: what they show, and what no profile can."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mortarbench.reports.data.aggregation import Ranking
from mortarbench.reports.document.formatting import clean, plural
from mortarbench.reports.document.layout import Cell, Picture, Section, Table, name_cell
from mortarbench.reports.figures.profiles import (
    banded,
    pairwise_figure,
    profile_figure,
    rivals,
    rows_of,
)
from mortarbench.reports.sections.ranking import described
from mortarbench.reports.statistics.profiles import (
    Array,
    performance_ratios,
    solved_within,
)

DRAWN = 4  #: groups that are drawn; all are tabulated
FACTORS = (1.0, 2.0, 5.0, 10.0)  #: of the table


def profiles(
    rankings: Sequence[Ranking], solvers: Sequence[str], left: tuple[str, ...] = ()
) -> Section:
    """Draw and tabulate the profiles of every group.

    solvers : of the whole report, which their looks go by
    left : what `reports.sections.ranking.left_out` says
    """
    name, title = "profiles", "Profiles"
    if not rankings:
        return Section(name=name, title=title, prose=left)
    drawn = rankings[:DRAWN]
    pictures = [
        picture
        for number, ranking in enumerate(drawn, 1)
        for picture in _pictures(ranking, solvers, number)
    ]
    rest = len(rankings) - len(drawn)
    return Section(
        name=name,
        title=title,
        prose=(
            "Performance profiles show the share of the cases that a solver solves "
            "within a factor of the best time of each case; data profiles, within a "
            "time. An answer that was not verified is infinitely late: it is never "
            "counted, whatever the factor. Bands are 95 % intervals of the share at "
            "each place by itself, for other cases of the same kind.",
            "A profile tells which solver is best for how many cases, and how often "
            "each succeeds. It does not rank the others: with another set of solvers "
            "the best time of a case is another, and their curves may change places "
            "(Gould and Scott 2016). Only a profile of two compares two, so the "
            "leader is set against each of the next in turn."
            + f" The first {len(drawn)} of {len(rankings)} groups are drawn."
            * bool(rest),
            *left,
        ),
        tables=tuple(map(_table, rankings)),
        pictures=tuple(pictures),
    )


def _pictures(ranking: Ranking, solvers: Sequence[str], number: int) -> list[Picture]:
    group = ranking.group
    pictures = [
        Picture(
            name=f"profiles-{number}",
            caption="Performance profiles (left) and data profiles (right), "
            f"{described(group)}{_remarks(ranking, solvers)}",
            figure=profile_figure(ranking, solvers),
        )
    ]
    if len(group.solvers) > 2:
        leader = clean(group.solvers[ranking.leader], 40)
        others = plural(len(rivals(ranking)), "solver")
        pictures.append(
            Picture(
                name=f"pairwise-{number}",
                caption=f"Performance profiles of two solvers each: {leader}, in "
                f"black, and the next {others} in the order of the means, "
                f"{described(group)}",
                figure=pairwise_figure(ranking, solvers),
            )
        )
    return pictures


def _remarks(ranking: Ranking, solvers: Sequence[str]) -> str:
    """Say what is grey where solvers share out among rows, and where bands are."""
    rows = rows_of(ranking, solvers)
    bands = "" if banded(ranking) else " Bands: in the next figure, pair by pair."
    if len(rows) < 2:
        return bands
    behind = len(ranking.group.solvers) - sum(map(len, rows))
    others = "the solvers of other rows"
    if behind:
        others += f" and {plural(behind, 'solver')} behind"
    return f" Rows roughly in the order of the means; grey: {others}.{bands}"


def _table(ranking: Ranking) -> Table:
    group = ranking.group
    ratios = performance_ratios(group.times)
    unsolved = int((~group.solved.any(axis=1)).sum())
    note = f"Nobody solved {plural(unsolved, 'case')}." * bool(unsolved)
    return Table(
        caption=f"Share of the cases solved within a factor of the best time, "
        f"{described(group)} {note}".rstrip(),
        columns=("solver", *(_head(f) for f in FACTORS), "at all"),
        rows=tuple(
            (name_cell(group.solvers[i]), *_shares(ratios[:, i])) for i in ranking.order
        ),
    )


def _head(factor: float) -> str:
    return "best" if factor == 1 else f"within {factor:g} ×"


def _shares(ratios: Array) -> list[Cell]:
    largest = np.finfo(float).max
    found = solved_within(ratios, (*FACTORS, largest))
    return [
        Cell(text=f"{value:.2f} [{low:.2f}, {high:.2f}]", value=float(value))
        for value, low, high in zip(*found, strict=True)
    ]
