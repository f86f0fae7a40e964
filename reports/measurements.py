"""The measurements of a result folder as data frames, from which reports are computed.

`Measurements.df` has one row per measurement: the fields of a record and the columns of
`DERIVED`. `Measurements.answers` has one row for all repeats of a solver on a case at a
tolerance, with the columns of `ANSWERS`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mortarbench.harness import InputError, Verdict
from mortarbench.harness.record import VERIFIED_FACTOR
from mortarbench.harness.results.folder import environment_of, times_compare
from mortarbench.harness.results.frame import frame_of
from mortarbench.harness.results.journal import read_journal
from mortarbench.harness.suite.suite import SuiteFile, read_suite
from mortarbench.harness.verify.kkt import rejudged

DERIVED = {
    "problem": "case without its form",
    "n": "degrees of freedom; for a QP without mechanics, variables",
    "m": "size of the dual: variables of a dual QP, else constraint rows of the QP",
    "verified": "whether the claim of the solver was verified",
    "residual": "largest of the four KKT residuals",
    "products": "products with P that the solver counted",
    "mesh_seconds": "time from the mesh: build, prepare, solve, recover, s",
    "severity": "position of the status in `SEVERITY`",
}
#: Statuses from the worst to the best; an answer has the worst status of its repeats.
SEVERITY = (
    Verdict.CRASHED,
    Verdict.WRONG,
    Verdict.INFEASIBLE_CLAIM,
    Verdict.UNBOUNDED_CLAIM,
    Verdict.FAILED,
    Verdict.MEMORY_LIMIT,
    Verdict.TIME_LIMIT,
    Verdict.ITERATION_LIMIT,
    Verdict.INACCURATE,
    Verdict.DECLINED,
    Verdict.VERIFIED_INFEASIBLE,
    Verdict.VERIFIED_UNBOUNDED,
    Verdict.VERIFIED,
)
_MARK_DIGITS = 6  #: digits of the digest in the mark of a QP
RESIDUALS = ("primal", "dual", "complementarity", "gap")
#: Columns that identify a cell, on which solvers are compared.
CELL = ["mode", "case", "tol"]
#: Columns that identify an answer.
KEY = ["environment", *CELL, "solver"]
#: Columns of an answer, with the aggregation over its repeats.
ANSWERS = {
    **dict.fromkeys(("family", "form", "problem", "qp", "arm", "ranks"), "first"),
    "n": "first",
    "m": "first",
    "run_id": "count",
    "severity": "min",
    "verified": "all",
    **dict.fromkeys(("total_seconds", "prepare_seconds", "solve_seconds"), "median"),
    **dict.fromkeys(("build_seconds", "dualise_seconds", "recover_seconds"), "median"),
    **dict.fromkeys(("certify_seconds", "mesh_seconds"), "median"),
    **dict.fromkeys(("iterations", "products"), "median"),
    **dict.fromkeys(("residual", "energy_bound", *RESIDUALS), "max"),
    **dict.fromkeys(("peak_mib",), "median"),
    **dict.fromkeys(("objective", "remembered", "message", "params"), "first"),
    **dict.fromkeys(("quantities", "counts", "vectors", "fields"), "first"),
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Measurements:
    """Measurements of a result folder, with the suite and the environments."""

    folder: Path
    df: pd.DataFrame  #: one row per measurement, in the order of the journal
    suite: SuiteFile | None = None  #: None if the suite is not stored
    #: environments by digest; environments with comparable times share one digest
    environments: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    factor: float = VERIFIED_FACTOR  #: residuals of verified answers are ≤ factor·tol

    @property
    def name(self) -> str:
        """Name of the suite; without a stored suite, name of the folder."""
        return self.suite.name if self.suite else self.folder.resolve().name

    @cached_property
    def solvers(self) -> tuple[str, ...]:
        """Labels of the solvers, in the order of the suite; others follow by name."""
        listed = [spec.label for spec in self.suite.specs()] if self.suite else []
        present = set(self.df.solver)
        ordered = dict.fromkeys([*listed, *sorted(present - set(listed))])
        return tuple(s for s in ordered if s in present)

    @cached_property
    def answers(self) -> pd.DataFrame:
        """One row for all repeats of a solver on a case at a tolerance."""
        grouped = self.df.groupby(KEY, sort=False, dropna=False)
        answers = grouped.agg(ANSWERS).reset_index()
        answers = answers.rename(columns={"run_id": "repeats"})
        answers["status"] = [SEVERITY[i].value for i in answers.severity]
        return answers.assign(series=series_of(answers))

    def selected(self, solvers: Sequence[str], cases: Sequence[str]) -> Measurements:
        """Return the measurements of some solvers and cases.

        solvers : labels; empty: all
        cases : names or patterns; empty: all
        """
        keep = [
            (not solvers or s in solvers)
            and (not cases or any(fnmatchcase(c, p) for p in cases))
            for s, c in zip(self.df.solver, self.df.case, strict=True)
        ]
        if not any(keep):
            raise InputError(
                f"{self.folder}: no measurement of {', '.join([*solvers, *cases])}; "
                f"expected names such as {self.df.case.iloc[0]}"
            )
        return replace(self, df=self.df[keep])

    def only(self, **values: Any) -> Measurements:
        """Return the measurements whose columns have the given values."""
        keep = np.ones(len(self.df), dtype=bool)
        for column, value in values.items():
            keep &= (self.df[column] == value).to_numpy()
        return replace(self, df=self.df[keep])


def read_measurements(folder: Path, factor: float = VERIFIED_FACTOR) -> Measurements:
    """Read the journal, the suite and the environments of a result folder.

    factor : residuals of verified answers are ≤ factor·tol; the journal uses 10·tol

    Raises
    ------
    InputError
        If the folder contains no measurements, or a file is malformed.

    """
    records = read_journal(folder)
    if not records:
        raise InputError(
            f"{folder}: no measurement in journal/*.jsonl; run a suite first"
        )
    if factor != VERIFIED_FACTOR:
        records = [r.replace(status=rejudged(r, factor)) for r in records]
    suite = folder / "suite.toml"
    df, environments = _united(folder, derived(frame_of(records)))
    return Measurements(
        folder=folder,
        df=df,
        suite=read_suite(suite) if suite.exists() else None,
        environments=environments,
        factor=factor,
    )


def derived(df: pd.DataFrame) -> pd.DataFrame:
    """Return a frame of records with the columns of `DERIVED`."""

    def of(column: str, *names: str) -> list[float]:
        return [
            float(sum(table[name] for name in names))
            if table and all(isinstance(table.get(name), int | float) for name in names)
            else np.nan
            for table in df[column]
        ]

    numbers = [
        *RESIDUALS, "energy_bound", "total_seconds", "prepare_seconds", "solve_seconds",
        "build_seconds", "dualise_seconds", "recover_seconds", "certify_seconds",
        "iterations", "peak_mib", "objective",
    ]  # fmt: skip
    df = df.astype(dict.fromkeys(numbers, float))
    variables = pd.Series(of("sizes", "variables"), index=df.index)
    rows = pd.Series(of("sizes", "equalities", "inequalities"), index=df.index)
    dofs = pd.Series(of("quantities", "dofs"), index=df.index)
    is_dual = df.form.str.startswith("dual")
    suffix = [len(f) + 1 if f else 0 for f in df.form]
    mesh = df[["build_seconds", "total_seconds", "recover_seconds"]]
    df = df.assign(
        problem=[c[: len(c) - k] for c, k in zip(df.case, suffix, strict=True)],
        # all forms of a problem have the dofs that any answer to it reports
        m=variables.where(is_dual, rows),
        verified=df.status.str.startswith(Verdict.VERIFIED.value),
        residual=df[[*RESIDUALS]].max(axis=1, skipna=False),
        products=of("counts", "P_products"),
        mesh_seconds=mesh.sum(axis=1, skipna=False),
        remembered=df.remembered.eq(True).fillna(False).astype(bool),
        severity=df.status.map({s.value: i for i, s in enumerate(SEVERITY)}),
    )
    known = dofs.groupby(df.problem).transform("first")
    df = df.assign(n=known.fillna(variables.where(~is_dual)))
    return _divided(df)


def _divided(df: pd.DataFrame) -> pd.DataFrame:
    """Divide cases of equal name whose QPs differ: the later QPs get a mark."""
    first = df.groupby(["environment", "case"], dropna=False).qp.transform("first")
    later = df.qp.notna() & (df.qp != first)
    if not later.any():
        return df
    marked = df.problem + "/QP=" + df.qp.str[:_MARK_DIGITS]
    form = ("/" + df.form).where(df.form != "", "")
    return df.assign(
        problem=df.problem.where(~later, marked),
        case=df.case.where(~later, marked + form),
    )


def _united(
    folder: Path, df: pd.DataFrame
) -> tuple[pd.DataFrame, dict[str, Mapping[str, Any]]]:
    """Replace each environment by the first one with comparable times."""
    environments: dict[str, Mapping[str, Any]] = {}
    united: dict[str, str] = {}
    for digest in dict.fromkeys(df.environment):
        try:
            environment = environment_of(folder, digest)
        except InputError:  # not stored: comparable with itself only
            environment = {}
        same = (
            d for d, e in environments.items() if e and times_compare(e, environment)
        )
        united[digest] = next(same, digest) if environment else digest
        environments.setdefault(united[digest], environment)
    return df.assign(environment=df.environment.map(united)), environments


def series_of(answers: pd.DataFrame) -> pd.Series:
    """Return a label of the series of each answer: family and keys that are not sizes.

    A key is not a size if cases of one family with equal n differ in it, such as the
    load step.
    """
    labels = pd.Series("", index=answers.index)
    for family, of in answers.groupby("family"):
        params = pd.DataFrame(list(of.params), index=of.index)
        fixed = [
            key
            for key in params
            if params[key].astype(str).groupby(of.n.fillna(of.m)).nunique().max() > 1
        ]
        shown = (
            params[fixed]
            .astype(str)
            .apply(lambda row: "/".join(f"{k}={v}" for k, v in row.items()), axis=1)
            if fixed
            else ""
        )
        labels[of.index] = family + ("/" if fixed else "") + shown
    return labels


def in_order(values: Sequence[str], order: Sequence[str]) -> list[str]:
    """Return distinct values in a given order; others follow."""
    rank = {name: i for i, name in enumerate(order)}
    return sorted(dict.fromkeys(values), key=lambda v: (rank.get(v, len(rank)), v))
