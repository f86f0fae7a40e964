"""Write the comparison of two or more result folders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
    """Write `after`/report/against-NAME, where NAME is the name of the folder `before`.

    The files are index.html for the format html, report.md for md, tables/ for tex, and
    tables/changes with a row per cell for csv and parquet. Equal journals give files
    with identical bytes.

    factor : residuals may be up to factor·tol, in both folders

    Returns
    -------
    conclusions in a few lines of text, and paths of the files

    Raises
    ------
    InputError
        If a folder is not a result folder, or has no measurements.

    """
    _, lines, written = write_comparisons(before, [after], formats, factor)
    return lines, written


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
    """Compare each further folder with the first one by `write_comparison`.

    If there are several further folders, a page on all of them is written to
    report/since-NAME in the last folder, where NAME is the name of the first.

    Returns
    -------
    the comparisons, their conclusions in a few lines of text, and paths of the files,
    of which the files of the page on all folders come first

    Raises
    ------
    InputError
        If a folder is not a result folder, or has no measurements.

    """
    before = read_evidence(first, factor)
    comparisons = [
        compare(before, read_evidence(other, factor), len(others)) for other in others
    ]
    lines, written = [], []
    for c in comparisons:
        if len(comparisons) > 1:
            lines.append(f"{c.before.directory} to {c.after.directory}:")
        lines += verdict_lines(c)
        written += _write(c, formats)
    if len(comparisons) > 1 and RENDERED & set(formats):
        target = others[-1] / "report" / f"since-{first.resolve().name}"
        written = [*write_page(overview(comparisons), target, formats), *written]
    return comparisons, lines, written


#: columns with results from one folder: name → type, and function from outcome to value
_SIDE: dict[str, tuple[str, Callable[[Outcome], Any]]] = {
    "verdict": ("string", lambda o: o.verdict.value),
    "seconds": ("float64", lambda o: t.value if (t := o.seconds("total")) else None),
    "iterations_min": ("Int64", lambda o: o.iterations[0] if o.iterations else None),
    "iterations_max": ("Int64", lambda o: o.iterations[1] if o.iterations else None),
    "energy": ("float64", lambda o: o.energy),
    "objective": ("float64", lambda o: o.first.objective),
}
#: columns for cells in both folders: name → type, and function from pair to value
_BOTH: dict[str, tuple[str, Callable[[Pair], Any]]] = {
    "ratio": ("float64", lambda p: p.ratio and p.ratio.value),
    "ratio_low": ("float64", lambda p: p.ratio and p.ratio.low),
    "ratio_high": ("float64", lambda p: p.ratio and p.ratio.high),
    "pairs": ("Int64", lambda p: p.ratio and p.ratio.pairs),
    "change": ("string", lambda p: p.ratio and ("none", "slower", "faster")[p.change]),
    "answers_apart": ("float64", lambda p: p.answers and p.answers[2]),
    "same_machine": ("boolean", lambda p: p.same_machine),
    "same_qp": ("boolean", lambda p: p.same_qp),
}


def changes_frame(c: Comparison) -> pd.DataFrame:
    """Return a row per cell of either folder, at full precision."""

    def row(
        before: Outcome | None, after: Outcome | None, **both: Any
    ) -> dict[str, Any]:
        one = after or before
        assert one is not None
        cell = {"case": one.case, "solver": one.solver, "tol": one.tol}
        for where, o in (("before", before), ("after", after)):
            if o is not None:
                cell |= {f"{name}_{where}": of(o) for name, (_, of) in _SIDE.items()}
        return cell | both

    rows = [
        row(p.before, p.after, **{name: of(p) for name, (_, of) in _BOTH.items()})
        for p in c.pairs
    ]
    rows += [row(o, None) for o in c.only_before]
    rows += [row(None, o) for o in c.only_after]
    kinds = {"case": "string", "solver": "string", "tol": "float64"}
    for name, (kind, _) in _SIDE.items():
        kinds |= {f"{name}_before": kind, f"{name}_after": kind}
    kinds |= {name: kind for name, (kind, _) in _BOTH.items()}
    return pd.DataFrame(rows, columns=list(kinds)).astype(kinds)
