"""The numbers behind the tables at full precision, as data frames for CSV."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from mortarbench.harness.files.csvfile import csv_text
from mortarbench.harness.results.frame import frame_of, with_texts
from mortarbench.reports.data.aggregation import (
    EVERY,
    USUAL,
    Convention,
    Ranking,
    rank_of,
    ranking_of,
)
from mortarbench.reports.data.aggregation import geometric_means as means_by
from mortarbench.reports.data.comparison_groups import (
    ComparisonGroup,
    comparison_groups,
)
from mortarbench.reports.data.environment import by_environment
from mortarbench.reports.data.evidence import RESIDUALS, Evidence, Outcome
from mortarbench.reports.data.quantities import spreads
from mortarbench.reports.data.size_series import SizeSeries, size_series
from mortarbench.reports.statistics.profiles import performance_ratios

_COUNTS = ("iterations", "iterations_min", "iterations_max", "n", "m")


def csv_tables(
    evidence: Evidence, *, pool_forms: bool = False
) -> dict[str, pd.DataFrame]:
    """Return every nonempty table by the stem of its file.

    The table `measurements` has one row per measurement; `outcomes` has one row per
    case, tolerance and solver, with medians of times and their intervals; `energies`
    and `scaling` contain the numbers of these sections of the report. For `contests`
    and `means`, see `comparison_tables`. Every row belongs to one environment, whose
    digest is in the column `environment`.

    pool_forms : compare the cases of all forms together
    """
    tables: dict[str, list[pd.DataFrame]] = {}
    for part in by_environment(evidence):
        for name, frame in _tables(part, pool_forms=pool_forms).items():
            if len(frame):
                digest = part.records[0].environment
                tables.setdefault(name, []).append(frame.assign(environment=digest))
    return {name: _counted(pd.concat(frames)) for name, frames in tables.items()}


def _tables(evidence: Evidence, *, pool_forms: bool) -> dict[str, pd.DataFrame]:
    """Return the tables of one environment."""
    tables = {
        "measurements": with_texts(frame_of(evidence.records)),
        "outcomes": pd.DataFrame(map(_outcome, evidence.flat)),
        "energies": pd.DataFrame(
            {
                "case": s.answers[0].physical,
                "tol": s.answers[0].tol,
                "answers": len(s.answers),
                "energy": s.best.energy,
                "largest_relative_difference": s.relative,
            }
            for s in spreads(evidence.flat)
        ),
        "scaling": pd.DataFrame(
            _law(series, solver)
            for series in size_series(evidence)
            for solver in series.solvers
        ),
    }
    return tables | comparison_tables(evidence, pool_forms=pool_forms)


def frame_csv(frame: pd.DataFrame) -> str:
    """Return a data frame as CSV text; `harness.files.csvfile` defines the format."""
    rows = frame.astype(object).where(frame.notna(), None)
    return csv_text(list(frame.columns), rows.itertuples(index=False, name=None))


def _counted(frame: pd.DataFrame) -> pd.DataFrame:
    """Convert counts with missing values to nullable integers."""
    counts = [name for name in _COUNTS if name in frame]
    return frame.astype(dict.fromkeys(counts, "Int64"))


def _outcome(o: Outcome) -> dict[str, Any]:
    least, most = o.iterations or (None, None)
    return {
        "case": o.case,
        "form": o.first.form,
        "tol": o.tol,
        "solver": o.solver,
        "verdict": o.verdict.value,
        "claimed": "; ".join(o.claims),
        "repeats": len(o.records),
        **{
            f"{phase}_seconds_{name}": getattr(o.seconds(phase), part, None)
            for phase in ("prepare", "solve", "total")
            for name, part in (("median", "value"), ("low", "low"), ("high", "high"))
        },
        "interval_coverage": getattr(o.seconds("total"), "coverage", None),
        "iterations_min": least,
        "iterations_max": most,
        **{name: o.largest(name) for name in (*RESIDUALS, "energy_bound")},
        "energy": o.energy,
        "n": o.size("dofs"),
        "m": o.size("equality_rows", "contact_rows"),
        "run_ids": " ".join(o.run_ids),
    }


def _law(series: SizeSeries, solver: str) -> dict[str, Any]:
    laws = {
        f"{what}{'_against_m' * (size == 'm')}": law(solver, size)
        for what, law in (
            ("time", series.time_law), ("iterations", series.iteration_law)
        )
        for size in ("n", "m")
    }  # fmt: skip
    return {
        "ladder": series.title,
        "solver": solver,
        "sizes": len(series.curve(solver)),
        **{
            f"{what}_{part}": getattr(law, part, None)
            for what, law in laws.items()
            for part in ("exponent", "low", "high", "factor")
        },
    }


def comparison_tables(
    evidence: Evidence, *, pool_forms: bool = False
) -> dict[str, pd.DataFrame]:
    """Return the tables `contests` and `means` of all comparable groups of cases.

    `contests` has one row per case and solver with the time and its ratio to the best
    time, both infinite for a failure; performance profiles are the distributions of
    these ratios. `means` has one row per solver and convention; intervals and tiers are
    given for the usual convention only.
    """
    groups = comparison_groups(evidence, pool_forms=pool_forms)
    return {
        "contests": pd.concat([pd.DataFrame(), *map(_cells, groups)]),
        "means": pd.DataFrame(
            [row for each in map(ranking_of, groups) for row in _means(each)]
        ),
    }


def _cells(group: ComparisonGroup) -> pd.DataFrame:
    """Return one row per case and solver."""
    cases, solvers = len(group.cases), len(group.solvers)
    return pd.DataFrame(
        {
            "contest": group.title,
            "case": np.repeat(_spelt(group.cases), solvers),
            "solver": np.tile(_spelt(group.solvers), cases),
            "seconds": group.times.ravel(),
            "ratio": performance_ratios(group.times).ravel(),
            "claimed_seconds": group.claimed.ravel(),
            "out_of_time_after": group.stopped.ravel(),
        }
    )


def _means(ranking: Ranking) -> list[dict[str, Any]]:
    """Return one row per convention and solver."""
    group = ranking.group
    usual: dict[str, Any] = dict(zip(("low", "high"), ranking.intervals, strict=True))
    names = ("ratio", "ratio_low", "ratio_high")
    usual |= dict(zip(names, ranking.ratios, strict=True))
    usual |= {"p_best": ranking.first, "tier": ranking.tiers}
    rows = []
    for convention in (*EVERY, Convention(common=True)):
        means = means_by(group, convention)
        columns = {"mean": means, "rank": rank_of(means)}
        columns |= usual if convention == USUAL else {}
        rows += [
            {"contest": group.title, "solver": solver}
            | vars(convention)
            | {name: values[i] for name, values in columns.items()}
            for i, solver in enumerate(_spelt(group.solvers))
        ]
    return rows


def _spelt(names: Sequence[str]) -> list[str]:
    """Escape lone surrogates, which text columns cannot contain."""
    return [name.encode(errors="backslashreplace").decode() for name in names]
