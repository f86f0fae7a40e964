"""The conditions in which two result folders differ, as a section of the page."""

from __future__ import annotations

from collections.abc import Sequence

from reports.changes import Comparison
from reports.comparison_words import cell_name
from reports.conditions import Difference, environments, options, settings
from reports.layout import Cell, Section, Table
from reports.wording import ABSENT, clean, plural


def conditions_that_differ(c: Comparison) -> Section:
    """List environments, settings and options that differ, and QPs that changed."""
    found = (
        ("Environments, as recorded.", environments(c.before, c.after)),
        ("Settings of the suites.", settings(c.before, c.after)),
        ("Options of solvers with one label.", options(c.before, c.after)),
    )
    tables = [_differing(caption, pairs) for caption, pairs in found if pairs]
    other = [p for p in c.pairs if not p.same_qp]
    prose = [] if tables else ["No condition differs."]
    if other:
        prose.append(
            f"{plural(len(other), 'cell')} had another QP after than before, bit for "
            "bit: the generator, its parameters' meaning or the BLAS changed. The "
            f"first: {cell_name(other[0])}. Where sizes differ, nothing is compared."
        )
    return Section(
        name="conditions",
        title="Conditions that differ",
        prose=tuple(prose),
        tables=tuple(tables),
    )


def _differing(caption: str, pairs: Sequence[Difference]) -> Table:
    return Table(
        caption=caption,
        columns=("key", "before", "after"),
        rows=tuple(
            (Cell(text=clean(k)), *(Cell(text=_plain(v), kind="words") for v in values))
            for k, *values in pairs
        ),
    )


def _plain(value: object) -> str:
    return ABSENT if value is None else clean(str(value), 120)
