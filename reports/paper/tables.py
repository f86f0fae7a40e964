"""Table 1 and the times of Section 5, beside what the paper says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mortarbench.harness.files.experiment import Experiment, Row
from mortarbench.reports.document.formatting import clean, seconds, significant
from mortarbench.reports.document.layout import Cell, Table
from mortarbench.reports.paper import published
from mortarbench.reports.paper.samples import curve

LINES = {  #: of the table of times → the parts of an analysis
    "mesh and assembly": ("assembly",),
    "Cholesky": ("factor",),
    "contact rows (the paper: mortar), all steps": ("contact",),
    "dualisation, all steps": ("dualisation",),
    "Cholesky and dualisation together": ("factor", "dualisation"),
    "dual QPs, all steps": ("qp",),
    "recovery of u, all steps": ("recovery",),
}
PARTS = tuple({part: None for parts in LINES.values() for part in parts})


def here(machine: dict[str, Any]) -> str:
    """Name the machine of the measurements."""
    cpu = machine.get("cpu") or "an unknown processor"
    return f"{cpu}, {machine.get('system', 'unknown system')}, one thread, Python"


def largest(experiment: Experiment) -> list[Row]:
    """Keep the measurements of the analysis at its largest size."""
    rows = experiment.tables["figure6"]
    last = max(int(row["Nr"]) for row in rows)
    return [row for row in rows if row["Nr"] == last]


def of_table_1(rows: Sequence[Row]) -> bool:
    """Say whether this is the size that the published times are of."""
    return (rows[0]["Nr"], rows[0]["Nh"]) == (30, 15)


def table_1(experiment: Experiment) -> Table:
    """Make Table 1, beside the paper's counts."""
    heads = ("nodes", "elements", "dofs")
    counted = experiment.tables["table1"]
    rows = []
    for row in counted:
        theirs = published.TABLE_1[str(row["body"])]
        ours = tuple(int(row[k]) for k in ("N", *heads, "segments"))
        cells = [Cell(text=str(v), value=v) for v in ours]
        rows.append((Cell(text=str(row["body"])), *cells, _agrees(ours == theirs)))
    sums = tuple(sum(int(r[k]) for r in counted) for k in heads)
    cells = [Cell(text=str(v), value=v) for v in sums]
    rows.append((
        Cell(text="total", kind="total"), Cell(text=""), *cells, Cell(text=""),
        _agrees(sums == published.TOTALS),
    ))  # fmt: skip
    return Table(
        caption="Parameters of the largest problem (the paper's Table 1).",
        columns=("", "N", *heads, "segments", "the paper"),
        rows=tuple(rows),
    )


def _agrees(same: bool) -> Cell:
    return Cell(text="the same" if same else "another size")


def timings(experiment: Experiment) -> Table:
    """Put Section 5's times beside ours."""
    rows = largest(experiment)
    lines = [_line(name, rows, parts) for name, parts in LINES.items()]
    lines.append(_line("total", rows, PARTS))
    steps = experiment.setting["plan"]["steps"]
    here_ = here(experiment.setting["environment"].get("machine", {}))
    return Table(
        caption=f"Section 5: times at Nr = {rows[0]['Nr']}, Nh = {rows[0]['Nh']}, "
        f"{steps} steps. Published: {published.MACHINE}; ours: {clean(here_)}. "
        "Condensed: the factor contains the condensation onto the interface, so "
        "compare it together with the dualisation. Ratio: published over ours "
        "condensed, two machines apart.",
        columns=("", "published", "ours, the paper's way", "ours, condensed", "ratio"),
        rows=tuple(lines),
    )


def _line(name: str, rows: list[Row], parts: tuple[str, ...]) -> tuple[Cell, ...]:
    kind = "total" if parts == PARTS else ""
    said = sum(published.SECONDS.get(part, 0.0) for part in parts)
    way, ours = (
        curve(rows, "n", method=m, part=parts)[0].time for m in ("per-row", "condensed")
    )
    ratio = Cell()
    if said and of_table_1(rows):
        value = said / ours.value
        low, high = (significant(said / t) for t in (ours.high, ours.low))
        ratio = Cell(text=f"{significant(value)} [{low}, {high}]", value=value)
    return (
        Cell(text=name, kind=kind),
        Cell(text=f"{said:.4g} s", value=said) if said else Cell(),
        Cell(text=seconds(way), value=way.value),
        Cell(text=seconds(ours), value=ours.value),
        ratio,
    )
