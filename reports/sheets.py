"""The numbers behind the tables at full precision, as data frames for CSV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import pandas as pd

from harness import Record, Verdict
from reports.contest_sheets import contest_sheets
from reports.data import RESIDUALS, Evidence, Outcome
from reports.intervals import PowerLaw
from reports.parquet import texts
from reports.physics import spreads
from reports.scaling import Ladder, ladders

_COUNTS = ("iterations", "iterations_min", "iterations_max", "n", "m")


def sheets(evidence: Evidence) -> dict[str, pd.DataFrame]:
    """Make every sheet by the name of its file; empty ones are left out.

    measurements: one row per journal line. outcomes: the repeats of one solver on one
    case together, every time a median with its interval. energies, scaling: as in the
    report. contests, means: see `reports.contest_sheets`.
    """
    found = {
        "measurements": _measurements(evidence.records),
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
            _law(ladder, solver)
            for ladder in ladders(evidence)
            for solver in ladder.solvers
        ),
    }
    found |= contest_sheets(evidence)
    return {name: _counted(frame) for name, frame in found.items() if len(frame)}


def _counted(frame: pd.DataFrame) -> pd.DataFrame:
    """Keep counts integers where some are missing."""
    counts = [name for name in _COUNTS if name in frame]
    return frame.astype(dict.fromkeys(counts, "Int64"))


def _measurements(records: Sequence[Record]) -> pd.DataFrame:
    """Give every field of every record a column; what is nested is JSON text."""
    columns = {f.name: [getattr(r, f.name) for r in records] for f in fields(Record)}
    for name, values in columns.items():
        if isinstance(values[0], Mapping | Verdict):
            columns[name] = list(texts(values))
    return pd.DataFrame(columns)


def _outcome(o: Outcome) -> dict[str, Any]:
    row: dict[str, Any] = {
        "case": o.case,
        "form": o.first.form,
        "tol": o.tol,
        "solver": o.solver,
        "verdict": o.verdict.value,
        "claimed": "; ".join(o.claims),
        "repeats": len(o.records),
    }
    for phase in ("prepare", "solve", "total"):
        interval = o.seconds(phase)
        for part in ("value", "low", "high"):
            name = "median" if part == "value" else part
            value = getattr(interval, part) if interval else None
            row[f"{phase}_seconds_{name}"] = value
    interval = o.seconds("total")
    row["interval_coverage"] = interval.coverage if interval else None
    row["iterations_min"], row["iterations_max"] = o.iterations or (None, None)
    row |= {name: o.largest(name) for name in (*RESIDUALS, "energy_bound")}
    row["energy"] = o.energy
    row["n"] = o.size("dofs")
    row["m"] = o.size("equality_rows", "contact_rows")
    row["run_ids"] = " ".join(o.run_ids)
    return row


def _law(ladder: Ladder, solver: str) -> dict[str, Any]:
    row: dict[str, Any] = {
        "ladder": ladder.title,
        "solver": solver,
        "sizes": len(ladder.curve(solver)),
    }
    laws: dict[str, PowerLaw | None] = {
        "time": ladder.time_law(solver),
        "time_against_m": ladder.time_law(solver, "m"),
        "iterations": ladder.iteration_law(solver),
        "iterations_against_m": ladder.iteration_law(solver, "m"),
    }
    for what, law in laws.items():
        for part in ("exponent", "low", "high", "factor"):
            row[f"{what}_{part}"] = getattr(law, part) if law else None
    return row
