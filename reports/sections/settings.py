"""Sections on cases, environment, definitions and limitations.

Every case is listed with all of its parameters and the sizes of its QP.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

from mortarbench.reports.data.cells import source
from mortarbench.reports.data.environment import flatten
from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.document.formatting import clean, plain_value, tolerance
from mortarbench.reports.document.grouping import grouped
from mortarbench.reports.document.layout import Cell, Part, Table
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.sections import Analysis, section

_SIZES = ("variables", "equalities", "inequalities", "bounds")
TEXT = Sentences(__name__)


@section(14, "cases", "Cases")
def cases(a: Analysis) -> Iterator[Part]:
    """Tabulate the cases of each family with all parameters, including defaults."""
    yield from TEXT.parts("cases")
    found = [
        # a declined or crashed build has no sizes
        (next((o for o in outcomes if o.first.sizes), outcomes[-1]), source(*outcomes))
        for outcomes in grouped(a.evidence.flat, lambda o: o.case).values()
    ]
    for family, mine in grouped(found, lambda each: each[0].first.family).items():
        yield _table(family, mine)


def _table(family: str, found: Sequence[tuple[Outcome, str]]) -> Table:
    """Return a table with a column per varying parameter; a note lists the others."""
    params = [o.first.params for o, _ in found]
    keys = dict.fromkeys(key for of in params for key in of)
    values = {key: {_parameter(key, each).text for each in found} for key in keys}
    fixed = {key: of.pop() for key, of in values.items() if len(of) == 1}

    def size(name: str, each: tuple[Outcome, str]) -> Cell:
        n = each[0].first.sizes.get(name)
        return Cell() if n is None else _value(n, 24, each[1])

    return Table.of(
        TEXT("family", family, len(found)),
        found,
        (
            ("case", lambda each: Cell.name(each[0].case)),
            ("form", lambda each: Cell.label(each[0].first.form, 24)),
            *((clean(k, 40), partial(_parameter, k)) for k in keys if k not in fixed),
            *((name, partial(size, name)) for name in _SIZES),
        ),
        notes=tuple(TEXT.parts("fixed", fixed, len(found)) if fixed else ()),
        text_columns=2,
    )


def _parameter(key: str, each: tuple[Outcome, str]) -> Cell:
    params = each[0].first.params
    return _value(params[key], 60) if key in params else Cell()


def _value(value: Any, limit: int, title: str = "") -> Cell:
    """Return a cell with a number or text; numbers are sorted by value."""
    number = float(value) if isinstance(value, int | float) else None
    return Cell(text=plain_value(value, limit), value=number, title=title)


@section(92, "environment", "Environment and settings")
def environment(a: Analysis) -> Iterator[Part]:
    """Tabulate settings, solver options and environment as recorded."""
    evidence = a.evidence
    tols = sorted({r.tol for r in evidence.records}, reverse=True)
    digests = sorted({r.environment for r in evidence.records if r.environment})
    limits = {
        "tolerances": ", ".join(map(tolerance, tols)),
        "verified if every residual ≤": f"{evidence.factor:g} × tolerance",
        "repeats, each prepared again": max(len(o.records) for o in evidence.flat),
        "time limit in s": evidence.suite.get("time_limit"),
        "memory limit in MiB": evidence.suite.get("memory_limit"),
        "environment digest": ", ".join(digests),
    }
    options = {r.solver: r.options for r in evidence.records}
    for caption, pairs in (
        (
            "Settings of the run.",
            [(k, v) for k, v in limits.items() if v not in (None, "")],
        ),
        (
            "Options of the solvers, including defaults.",
            [
                (f"{solver}.{key}", value)
                for solver in evidence.solvers
                if options[solver]
                for key, value in flatten(options[solver])
            ],
        ),
        (
            "Environment, as recorded with the measurements.",
            flatten(evidence.environment) if evidence.environment else [],
        ),
    ):
        if pairs:
            yield Table.of(
                caption,
                pairs,
                (
                    ("key", lambda pair: Cell.label(pair[0], 96)),
                    ("value", lambda pair: Cell.words(_plain(pair[1]))),
                ),
            )


def _plain(value: Any) -> str:
    match value:
        case None:
            return "unknown"
        case bool():
            return "yes" if value else "no"
        case list() | tuple():
            return clean(", ".join(map(str, value)), 400) or "none"
        case _:
            return plain_value(value, 400)


@section(94, "definitions", "Definitions and limitations")
def definitions(a: Analysis) -> Iterator[Part]:
    """Define residuals and verdicts, and state the limitations of the report."""
    yield from TEXT.parts("definitions", a.evidence.factor)
