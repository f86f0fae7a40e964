"""What finer meshes told of the error of each mesh."""

from __future__ import annotations

from collections.abc import Sequence

from mortarbench.harness.crossval.discretisation import Discretisation
from mortarbench.reports.document.formatting import ABSENT, clean, power
from mortarbench.reports.document.layout import Cell, Table


def mesh_table(found: Sequence[Discretisation]) -> Table:
    """List the error of every mesh, or why it is not known."""
    return Table(
        caption="Errors of the meshes: relative, in the energy norm.",
        notes=(
            "From the solutions on meshes with every cell halved once and twice; the "
            "reference solve found them, no solver under test. Rate: of the error, "
            "like h to that power.",
        ),
        columns=("physical case", "unknowns", "error", "rate", "finest mesh", "note"),
        rows=tuple(_mesh(d) for d in found),
    )


def _mesh(d: Discretisation) -> tuple[Cell, ...]:
    sizes = [level.unknowns for level in d.levels]
    note = {
        "limit": "; ".join(filter(None, ["against the limit of fine meshes", d.note])),
        "change": f"to the next mesh only: {d.note}",
        "rounding": "the mesh holds the solution; what rounding hides",
    }.get(d.kind, d.note)
    less = "< " if d.kind == "rounding" else ""
    return (
        Cell.name(d.case),
        _count(sizes[0] if sizes else None),
        Cell(text=less + power(d.error) if d.error else ABSENT, value=d.error),
        Cell(text=ABSENT if d.rate is None else f"{d.rate / 2:.2f}", value=d.rate),
        _count(sizes[-1] if len(sizes) > 1 else None),
        Cell(text=clean(note, 200), kind="words"),
    )


def _count(n: int | None) -> Cell:
    return Cell() if n is None else Cell(text=str(n), value=n)
