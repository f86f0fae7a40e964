"""What finer meshes told of the error of each mesh."""

from __future__ import annotations

from collections.abc import Sequence

from mortarbench.harness.crossval.discretisation import Discretisation
from mortarbench.reports.document.formatting import ABSENT, clean, power
from mortarbench.reports.document.layout import Cell, Table


def mesh_table(found: Sequence[Discretisation]) -> Table:
    """List the error of every mesh, or why it is not known."""

    def unknowns(d: Discretisation, level: int) -> Cell:
        known = len(d.levels) > level
        return Cell.number(d.levels[-1 if level else 0].unknowns if known else None)

    def error(d: Discretisation) -> Cell:
        less = "< " if d.kind == "rounding" else ""
        return Cell(text=less + power(d.error) if d.error else ABSENT, value=d.error)

    def note(d: Discretisation) -> Cell:
        text = {
            "limit": "; ".join(
                filter(None, ["against the limit of fine meshes", d.note])
            ),
            "change": f"to the next mesh only: {d.note}",
            "rounding": "the mesh holds the solution; what rounding hides",
        }.get(d.kind, d.note)
        return Cell.words(clean(text, 200))

    return Table.of(
        "Errors of the meshes: relative, in the energy norm.",
        found,
        (
            ("physical case", lambda d: Cell.name(d.case)),
            ("unknowns", lambda d: unknowns(d, 0)),
            ("error", error),
            ("rate", lambda d: Cell.number(d.rate, lambda q: f"{q / 2:.2f}")),
            ("finest mesh", lambda d: unknowns(d, 1)),
            ("note", note),
        ),
        notes=(
            "From the solutions on meshes with every cell halved once and twice; the "
            "reference solve found them, no solver under test. Rate: of the error, "
            "like h to that power.",
        ),
    )
