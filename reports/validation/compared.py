"""What a cross-validation compared, what stands out, and what is not in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mortarbench.reports.document.formatting import (
    ABSENT,
    clean,
    listing,
    power,
    tolerance,
)
from mortarbench.reports.document.layout import Cell, Section, Table, name_cell

Data = Mapping[str, Any]


def problems(data: Data) -> Section:
    """List every problem with how far its answers lie apart."""
    table = Table(
        caption="Every problem: all pairs of answers, of each solver and form.",
        columns=(
            "problem", "answers", "pairs", "closed rows", "error of the reference",
            "largest distance", "of forces", "of energies", "between",
        ),
        rows=tuple(map(_problem, data["problems"])),
        notes=(
            "Distances in the energy norm over ‖u*‖, energies over ½‖u*‖². A problem "
            "is a case without its form; without mechanics (file:), one QP, and the "
            "norm is that of P.",
        ),
    )  # fmt: skip
    return Section(name="problems", title="Problems", tables=(table,))


def _problem(p: Data) -> tuple[Cell, ...]:
    pairs, answers = p["pairs"], p["answers"]
    farthest = max(pairs, key=_distance, default=None)
    between = ABSENT
    if farthest is not None:
        between = " and ".join(_who(answers[farthest[k]]) for k in ("a", "b"))
    truth = "" if p["truth"] == "reference" else clean(p["truth"] or "none", 40)
    return (
        name_cell(p["name"]),
        count_cell(len(answers)),
        count_cell(len(pairs)),
        Cell() if p["closed"] is None else count_cell(p["closed"]),
        Cell(text=power(p["doubt"]), value=p["doubt"], after=truth),
        number_cell(_largest(pairs, "distance")),
        number_cell(_largest(pairs, "equilibrium")),
        number_cell(_largest(pairs, "energy")),
        Cell(text=clean(between, 80), kind="words"),
    )


def _distance(pair: Data) -> float:
    found = [pair[k] for k in ("distance", "equilibrium") if pair[k] is not None]
    return max(found, default=float("inf"))


def _who(a: Data) -> str:
    return f"{a['solver']} on {a['form']}"


def remarks(data: Data) -> Section | None:
    """Say per solver how often it stands out, and where most."""
    grouped: dict[str, list[Data]] = {}
    for d in data["remarks"]:
        grouped.setdefault(d["solver"], []).append(d)
    if not grouped:
        return None
    rows = []
    for solver, mine in grouped.items():
        worst = max(mine, key=lambda d: d["error"] or 0.0)
        rows.append(
            (
                Cell(text=clean(solver, 40)),
                count_cell(len({d["run_id"] for d in mine})),
                number_cell(worst["error"]),
                Cell(text=clean(worst["case"]), kind="words"),
                Cell(text=clean(worst["text"], 200), kind="words"),
            )
        )
    table = Table(
        caption="Answers within what they claim that stand out from the others.",
        columns=("solver", "answers", "largest error", "on", "what"),
        rows=tuple(rows),
    )
    return Section(name="remarks", title="What stands out", tables=(table,))


def left_out(data: Data) -> Section | None:
    """List what was asked and not answered, and what could not be judged."""
    named = (
        ("unanswered", "Measurements that ended without a claim."),
        ("not_validated", "Stored answers that could not be judged."),
    )
    tables = tuple(_together(words, data[key]) for key, words in named if data[key])
    points = tuple(
        f"{clean(d['problem'])}: {clean(d['text'], 300)}; "
        + (f"{clean(d['truth'], 60)} stands for it" if d["truth"] else "residuals only")
        for d in data["without_reference"]
    )
    prose = ("These problems have no reference point:",) if points else ()
    if not tables and not points:
        return None
    return Section(
        name="left-out", title="Not compared", prose=prose, points=points,
        tables=tables,
    )  # fmt: skip


def _together(caption: str, entries: Sequence[Data]) -> Table:
    """Make one row of what a solver did alike on several cases."""
    grouped: dict[tuple[str, str], list[str]] = {}
    for d in sorted(entries, key=lambda d: (d["solver"], d["text"], d["case"])):
        grouped.setdefault((d["solver"], d["text"]), []).append(d["case"])
    rows = (
        (
            Cell(text=clean(solver, 40)),
            count_cell(len(cases)),
            Cell(text=clean(text, 240), kind="words"),
            Cell(
                text=listing(unique := list(dict.fromkeys(cases)), 2),
                kind="words",
                title=clean(", ".join(unique), 2000),
            ),
        )
        for (solver, text), cases in grouped.items()
    )
    return Table(
        caption=caption,
        columns=("solver", "times", "what", "on"),
        rows=tuple(rows),
    )


def listed(caption: str, entries: Sequence[Data]) -> Table:
    """Make one row of each entry that something is said of."""
    return Table(
        caption=caption,
        columns=("solver", "case", "tol", "what"),
        rows=tuple(
            (
                Cell(text=clean(d["solver"], 40), title=run(d)),
                name_cell(d["case"]),
                tol_cell(d),
                Cell(text=clean(d["text"], 240), kind="words"),
            )
            for d in entries
        ),
        text_columns=2,
    )


def run(d: Data) -> str:
    """Name the measurement behind an entry."""
    return f"run {clean(d['run_id'], 40)}"


def _largest(pairs: Sequence[Data], name: str) -> float | None:
    return max((p[name] for p in pairs if p[name] is not None), default=None)


def tol_cell(d: Data) -> Cell:
    """Show the tolerance of an entry."""
    return Cell(text=tolerance(d["tol"]), value=d["tol"])


def count_cell(n: int) -> Cell:
    """Show a count."""
    return Cell(text=str(n), value=n)


def number_cell(value: float | None) -> Cell:
    """Show an order of magnitude."""
    return Cell(text=power(value), value=value)
