"""Write what changed between two result folders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from mortarbench.harness.files.durable import replacing
from mortarbench.harness.record import VERIFIED_FACTOR
from mortarbench.reports.compare.changes import Comparison, Pair, compare
from mortarbench.reports.compare.conclusions import verdict_lines
from mortarbench.reports.compare.overview import overview
from mortarbench.reports.compare.page import compose
from mortarbench.reports.data.evidence import Outcome, read_evidence
from mortarbench.reports.export.csv_tables import frame_csv
from mortarbench.reports.render.writing import RENDERED, write_page, write_text


def write_comparison(
    before: Path, after: Path, formats: Sequence[str], factor: float = VERIFIED_FACTOR
) -> tuple[list[str], list[Path]]:
    """Write AFTER/report/against-NAME, NAME being that of the folder `before`.

    html: index.html. md: report.md. tex: tables/. csv, parquet: tables/changes, a row
    per cell. The same journals give the same bytes.

    factor : verdicts are those at factor·tol, in both folders

    Returns
    -------
    the verdict in a few lines of text, and the files

    Raises
    ------
    InputError
        When one is no result folder, or holds no measurements.

    """
    _, said, written = write_comparisons(before, [after], formats, factor)
    return said, written


def _write(comparison: Comparison, formats: Sequence[str]) -> list[Path]:
    """Write the page and the table on two folders."""
    before, after = comparison.before.directory, comparison.after.directory
    target = after / "report" / f"against-{before.resolve().name}"
    written: list[Path] = []
    if RENDERED & set(formats):
        written = write_page(compose(comparison), target, formats)
    tables, frame = target / "tables", changes_frame(comparison)
    if "csv" in formats:
        text = frame_csv(frame)
        written.append(write_text(tables / "changes.csv", text))
    if "parquet" in formats:
        tables.mkdir(parents=True, exist_ok=True)
        with replacing(tables / "changes.parquet") as file:
            frame.to_parquet(file, index=False)
        written.append(tables / "changes.parquet")
    return written


def write_comparisons(
    first: Path,
    others: Sequence[Path],
    formats: Sequence[str],
    factor: float = VERIFIED_FACTOR,
) -> tuple[list[Comparison], list[str], list[Path]]:
    """Compare several folders with the first one, each as `write_comparison` does.

    Of more than one, LAST/report/since-NAME has a page on all, NAME being that of the
    first.

    Returns
    -------
    the comparisons, the verdicts in a few lines of text, and the files, that page first

    Raises
    ------
    InputError
        When one is no result folder, or holds no measurements.

    """
    before = read_evidence(first, factor)
    found = [
        compare(before, read_evidence(other, factor), len(others)) for other in others
    ]
    said, written = [], []
    for c in found:
        if len(found) > 1:
            said.append(f"{c.before.directory} to {c.after.directory}:")
        said += verdict_lines(c)
        written += _write(c, formats)
    if len(found) > 1 and RENDERED & set(formats):
        target = others[-1] / "report" / f"since-{first.resolve().name}"
        written = [*write_page(overview(found), target, formats), *written]
    return found, said, written


def changes_frame(c: Comparison) -> pd.DataFrame:
    """Make a row per cell of either folder, at full precision."""
    rows = [_paired(p) for p in c.pairs]
    rows += [
        {**_cell(o), **_side(o, where)}
        for where, alone in (("before", c.only_before), ("after", c.only_after))
        for o in alone
    ]
    frame = pd.DataFrame(rows, columns=list(_COLUMNS))
    return frame.astype(_COLUMNS)


def _paired(p: Pair) -> dict[str, Any]:
    ratio, answers = p.ratio, p.answers
    return {
        **_cell(p.after),
        **_side(p.before, "before"),
        **_side(p.after, "after"),
        "ratio": ratio.value if ratio else None,
        "ratio_low": ratio.low if ratio else None,
        "ratio_high": ratio.high if ratio else None,
        "pairs": ratio.pairs if ratio else None,
        "change": {1: "slower", 0: "none", -1: "faster"}[p.change] if ratio else None,
        "answers_apart": answers[2] if answers else None,
        "same_machine": p.same_machine,
        "same_qp": p.same_qp,
    }


def _cell(o: Outcome) -> dict[str, Any]:
    return {"case": o.case, "solver": o.solver, "tol": o.tol}


def _side(o: Outcome, where: str) -> dict[str, Any]:
    time = o.seconds("total")
    least, most = o.iterations or (None, None)
    return {
        f"verdict_{where}": o.verdict.value,
        f"seconds_{where}": time.value if time else None,
        f"iterations_min_{where}": least,
        f"iterations_max_{where}": most,
        f"energy_{where}": o.energy,
        f"objective_{where}": o.first.objective,
    }


_COLUMNS: dict[str, str] = {
    "case": "string", "solver": "string", "tol": "float64",
    **{
        f"{name}_{where}": kind
        for name, kind in (
            ("verdict", "string"), ("seconds", "float64"),
            ("iterations_min", "Int64"), ("iterations_max", "Int64"),
            ("energy", "float64"), ("objective", "float64"),
        )
        for where in ("before", "after")
    },
    "ratio": "float64", "ratio_low": "float64", "ratio_high": "float64",
    "pairs": "Int64", "change": "string", "answers_apart": "float64",
    "same_machine": "boolean", "same_qp": "boolean",
}  # fmt: skip
