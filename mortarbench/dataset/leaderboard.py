"""Leaderboard of the public set: measure solvers on its core, and write the page."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

from mortarbench.dataset.items import OPTIMAL, Row, catalogue
from mortarbench.harness import checked
from mortarbench.reporting import Report
from mortarbench.results import run

#: Kinds of sequences, by a part of their names; in others, loads or bounds grow.
KINDS = {
    "jumps": "jumps",
    "iterations": "Coulomb iterations",
    "newton": "Newton steps",
}
GROWTH = "growing loads, bounds"
#: Solvers that are measured unless others are requested.
FLEET = (
    "smalbe", "pdas", "osqp", "clarabel", "proxqp", "piqp", "daqp",
    "qpalm", "qoco", "qtqp", "scs", "highs",
)  # fmt: skip


def leaderboard(folder: str | Path, **options: Any) -> Report:
    """Measure solvers on the core and the sequences of a set, and rank them by class.

    All solvers have the tolerance 1e-6, at which their answers are judged. The steps of
    sequences are solved cold and with warm starts.

    Parameters
    ----------
    folder : folder of `build`
    options : arguments of `mortarbench.run`, such as solvers, plugins, repeats and out,
        which is ``out/leaderboard`` by default

    Raises
    ------
    InputError
        If the folder is not a set, or an argument is invalid.

    """
    path = checked.path("folder", folder).resolve()
    rows = [r for r in catalogue(path) if r["core"] == "yes" or r["sequence"]]
    files = {row["name"]: str(path / row["path"]) for row in rows}
    problems: list[dict[str, Any]] = [
        {"family": "file", "params": {"path": [*files.values()]}}
    ]
    for sequence, steps in groupby(rows, lambda row: row["sequence"]):
        if sequence:
            paths = [files[row["name"]] for row in steps]
            problems.append(
                {"family": "file", "params": {"path": paths}, "sequence": "path"}
            )
    suite = {
        "name": "leaderboard",
        "tolerances": [1e-6],
        "repeats": 2,
        "time_limit": 2.0,  # s; about 100 times the time of the fastest solver
        "solvers": FLEET,
        "problems": problems,
    }
    measured = run(suite, **options)
    import pandas as pd

    from mortarbench.reports.leaderboard import write_leaderboard

    items = pd.DataFrame(
        {"case": f"file:{files[row['name']]}", "group": group}
        | {key: row[key] for key in ("name", "sequence")}
        | {"step": int(row["step"] or 0)}
        for row in rows
        for group in groups(row)
    )
    written, said = write_leaderboard(measured.folder, items)
    return Report(files=tuple(written), said=tuple(said))


def groups(row: Row) -> Iterator[str]:
    """Yield the classes of a problem, or the kind of a sequence."""
    if parts := row["sequence"].split("-")[1:]:
        yield next((kind for part, kind in KINDS.items() if part in parts), GROWTH)
    elif row["kind"] != OPTIMAL:
        yield "no solution"
    elif row["discs"] != "0":
        yield "discs"
    else:
        yield "dense" if row["dense"] == "yes" else "sparse"
        yield "strictly convex" if row["strictly_convex"] == "yes" else "singular"
