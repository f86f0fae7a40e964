"""The numbers behind means, ranks and profiles, as data frames for CSV."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from reports.contests import Contest, contests
from reports.conventions import EVERY, USUAL, Convention, Standing, standing
from reports.conventions import geometric_means as means_by
from reports.data import Evidence
from reports.profiles import performance_ratios
from reports.ranking import ranks


def contest_sheets(evidence: Evidence) -> dict[str, pd.DataFrame]:
    """Make the sheets of all contests.

    contests: a row per case and solver with its time and its ratio to the best, both
    infinite for a failure; profiles are their distributions. means: a row per solver
    and convention, with intervals and tiers where they are made, at the usual one.
    """
    found = contests(evidence)
    return {
        "contests": pd.concat([pd.DataFrame(), *map(_cells, found)]),
        "means": pd.DataFrame(
            [row for each in map(standing, found) for row in _means(each)]
        ),
    }


def _cells(contest: Contest) -> pd.DataFrame:
    """One row per case and solver."""
    cases, solvers = len(contest.cases), len(contest.solvers)
    return pd.DataFrame(
        {
            "contest": contest.title,
            "case": np.repeat(_spelt(contest.cases), solvers),
            "solver": np.tile(_spelt(contest.solvers), cases),
            "seconds": contest.times.ravel(),
            "ratio": performance_ratios(contest.times).ravel(),
            "claimed_seconds": contest.claimed.ravel(),
            "out_of_time_after": contest.stopped.ravel(),
        }
    )


def _means(standing: Standing) -> list[dict[str, Any]]:
    """One row per convention and solver."""
    contest = standing.contest
    usual: dict[str, Any] = {
        "low": standing.intervals[0],
        "high": standing.intervals[1],
    }
    names = ("ratio", "ratio_low", "ratio_high")
    usual |= dict(zip(names, standing.ratios, strict=True))
    usual |= {"p_best": standing.first, "tier": standing.tiers}
    rows = []
    for convention in (*EVERY, Convention(common=True)):
        found = means_by(contest, convention)
        ranked = ranks(found)
        more = usual if convention == USUAL else {}
        for i, solver in enumerate(_spelt(contest.solvers)):
            rows.append(
                {"contest": contest.title, "solver": solver}
                | vars(convention)
                | {"mean": found[i], "rank": ranked[i]}
                | {name: values[i] for name, values in more.items()}
            )
    return rows


def _spelt(names: Sequence[str]) -> list[str]:
    """Spell out lone surrogates, which no file can hold."""
    return [name.encode(errors="backslashreplace").decode() for name in names]
