"""What was solved: every case with all of its parameters, and the sizes of its QP."""

from __future__ import annotations

from collections.abc import Mapping

from reports.data.cells import source
from reports.data.evidence import Evidence, Outcome
from reports.document.formatting import ABSENT, clean, plural
from reports.document.layout import Cell, Section, Table, name_cell

_SIZES = ("variables", "equalities", "inequalities", "bounds")


def cases(evidence: Evidence) -> Section:
    """List every case, one table per family; records hold defaults with the rest."""
    found: dict[str, Outcome] = {}
    measured: dict[str, list[Outcome]] = {}
    for o in evidence.flat:
        measured.setdefault(o.case, []).append(o)
        if o.case not in found or not found[o.case].first.sizes:
            found[o.case] = o
    runs = {case: source(*outcomes) for case, outcomes in measured.items()}
    families = dict.fromkeys(o.first.family for o in found.values())
    return Section(
        name="cases",
        title="Cases",
        prose=(
            "A case name lists the parameters that differ from the defaults of the "
            "family; here are all of them, and the sizes of the QP that solvers got.",
        ),
        tables=tuple(
            _table(
                family, [o for o in found.values() if o.first.family == family], runs
            )
            for family in families
        ),
    )


def _table(family: str, outcomes: list[Outcome], runs: Mapping[str, str]) -> Table:
    """Give every parameter that varies a column, and the caption the others."""
    keys = list(dict.fromkeys(k for o in outcomes for k in o.first.params))
    values = {k: [_value(o, k) for o in outcomes] for k in keys}
    fixed = {k: v[0] for k, v in values.items() if len(set(v)) == 1}
    varying = [k for k in keys if k not in fixed]
    shared = ", ".join(f"{clean(k, 40)} = {v}" for k, v in fixed.items())
    count = plural(len(outcomes), "case")
    rows = [
        (
            name_cell(o.case),
            Cell(text=clean(o.first.form, 24)),
            *(_parameter(o, k) for k in varying),
            *(_size(o, name, runs[o.case]) for name in _SIZES),
        )
        for o in outcomes
    ]
    return Table(
        caption=f"Cases of {clean(family, 40)}: {count}.",
        notes=(f"{'The same for all' if rows[1:] else 'Parameters'}: {shared}.",)
        if shared
        else (),
        columns=("case", "form", *(clean(k, 40) for k in varying), *_SIZES),
        rows=tuple(rows),
        text_columns=2,
    )


def _value(outcome: Outcome, key: str) -> str:
    params = outcome.first.params
    return clean(str(params[key]), 60) if key in params else ABSENT


def _parameter(outcome: Outcome, key: str) -> Cell:
    value = outcome.first.params.get(key)
    number = float(value) if isinstance(value, int | float) else None
    return Cell(text=_value(outcome, key), value=number)


def _size(outcome: Outcome, name: str, runs: str) -> Cell:
    n = outcome.first.sizes.get(name)
    if n is None:
        return Cell()
    return Cell(text=clean(str(n), 24), value=_number(n), title=runs)


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None
