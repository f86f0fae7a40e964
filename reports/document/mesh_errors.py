"""Table of discretisation errors, estimated on finer meshes."""

from __future__ import annotations

from collections.abc import Sequence

from mortarbench.harness.crossval.discretisation import Discretisation
from mortarbench.reports.document.formatting import ABSENT, clean, power
from mortarbench.reports.document.layout import Cell, Table


def mesh_table(meshes: Sequence[Discretisation]) -> Table:
    """Tabulate the error of every mesh, or the reason why it is unknown."""

    def unknowns(d: Discretisation, level: int) -> Cell:
        known = len(d.levels) > level
        return Cell.number(d.levels[-1 if level else 0].unknowns if known else None)

    def error(d: Discretisation) -> Cell:
        less = "< " if d.kind == "rounding" else ""
        return Cell(text=less + power(d.error) if d.error else ABSENT, value=d.error)

    def note(d: Discretisation) -> Cell:
        text = {
            "limit": "; ".join(
                filter(None, ["relative to the limit of fine meshes", d.note])
            ),
            "change": f"only the change to the next mesh is known: {d.note}",
            "rounding": "the mesh represents the solution exactly, up to rounding",
        }.get(d.kind, d.note)
        return Cell.words(clean(text, 200))

    return Table.of(
        "Relative discretisation errors in the energy norm.",
        meshes,
        (
            ("physical case", lambda d: Cell.name(d.case)),
            ("unknowns", lambda d: unknowns(d, 0)),
            ("error", error),
            ("rate", lambda d: Cell.number(d.rate, lambda q: f"{q / 2:.2f}")),
            ("finest mesh", lambda d: unknowns(d, 1)),
            ("note", note),
        ),
        notes=(
            "Estimated from reference solutions on meshes whose cell size h is halved "
            "once and twice, without a solver under test. Rate: exponent of h in the "
            "error.",
        ),
    )
