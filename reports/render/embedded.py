"""Data for the script of the page: tables, plots and measurements as compact JSON."""

from __future__ import annotations

import gzip
import json
from base64 import b64encode
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from mortarbench.harness import Record
from mortarbench.harness.record import finite
from mortarbench.reports.document.figure import Figure
from mortarbench.reports.document.formatting import VERDICTS, clean, tolerance
from mortarbench.reports.document.layout import Cell, Page, Table, named, short
from mortarbench.reports.figures.style import look
from mortarbench.reports.render.plots import Data, panels

Rows = Mapping[str, int]  #: identity in the short form of titles → index of the record


def rows_of(records: Sequence[Record]) -> Rows:
    """Map every identity to its index in the order of the report."""
    return {short(r.identity): i for i, r in enumerate(records)}


def data(page: Page, plots: Sequence[list[Data]], rows: Rows) -> str:
    """Serialise solvers, tables, plots and filter keys; for records, see `details`."""
    looks = [(name, look(i)) for i, name in enumerate(page.solvers)]
    return script(
        {
            "solvers": [
                {
                    "names": [clean(s, 40), clean(s)],
                    "colour": k.colour,
                    "marker": k.marker,
                }
                for s, k in looks
            ],
            "tables": [table(t, rows) for s in page.sections for t in s.tables],
            "plots": plots,
            "runs": _keys(page.records),
        }
    )


def details(records: Sequence[Record]) -> str:
    """Serialise all fields of all measurements: columns as JSON, gzip and base64.

    A column is a list of values or, if few values are distinct, the list of distinct
    values and a list of indices.
    """
    lines = [_as_journalled(r) for r in records]
    columns = {
        name: [getattr(r, name) for r in lines] for name in Record.__struct_fields__
    }
    text = strict({name: _column(values) for name, values in columns.items()})
    return b64encode(gzip.compress(text.encode(), 5, mtime=0)).decode()


def _as_journalled(record: Record) -> Record:
    """Restore the solver label of the journal, without the mode of a sequence."""
    mode = f" ({record.mode})"
    suffixed = record.mode != "cold" and record.solver.endswith(mode)
    return (
        record.replace(solver=record.solver.removesuffix(mode)) if suffixed else record
    )


def script(content: Any) -> str:
    """Serialise as JSON that is safe within <script>: no tag, comment or line end."""
    text = strict(content)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def strict(content: Any) -> str:
    """Serialise as ASCII JSON; NaN and inf become null, as in the journal."""
    write = partial(json.dumps, allow_nan=False, separators=(",", ":"))
    try:
        return write(content)
    except ValueError:  # rare: checking for NaN first would cost more than writing
        return write(finite(content))


def plots(page: Page, rows: Rows) -> dict[str, list[Data]]:
    """Return the plot data of every figure of curves, by the name of the figure."""
    solvers = {s: i for i, s in enumerate(page.solvers)}
    return {
        picture.name: [_numbered(one, rows) for one in panels(picture.figure, solvers)]
        for section in page.sections
        for picture in section.pictures
        if isinstance(picture.figure, Figure)
    }


def _numbered(panel: Data, rows: Rows) -> Data:
    """Replace identities by indices of records."""
    traces = [
        {**t, "runs": [spans(map(short, ids), rows) for ids in t.get("runs", ())]}
        for t in panel["traces"]
    ]
    return {**panel, "traces": traces}


def table(t: Table, rows: Rows) -> Data:
    """Return headings and cells, and the solver if the table concerns only one."""
    return {
        "columns": list(t.columns),
        "words": t.text_columns,
        "solver": clean(t.solver, 40),
        "rows": [[cell(c, rows) for c in row] for row in t.rows],
    }


def cell(c: Cell, rows: Rows) -> Any:
    """Return the text if a cell has no other data, otherwise a list of its fields.

    Empty fields at the end of the list are omitted. The seventh field contains the
    measurements as packed by `spans`.
    """
    value = None if c.value is None else float(f"{c.value:.9g}")
    runs = runs_of(c, rows)
    title = "" if runs and c.title.startswith("run ") else c.title
    full = [c.text, value, c.kind, c.symbol, c.after, title, runs or None]
    while len(full) > 1 and full[-1] in (None, ""):
        full.pop()
    return full if len(full) > 1 else c.text


def runs_of(c: Cell, rows: Rows) -> list[int]:
    """Return the packed indices of the measurements listed in the title of a cell."""
    return spans(named(c.title), rows)


def spans(ids: Iterable[str], rows: Rows) -> list[int]:
    """Pack the indices of measurements into pairs (first, count); omit unknown ids."""
    packed: list[int] = []
    for at in (rows[i] for i in ids if i in rows):
        if packed and at == packed[-2] + packed[-1]:
            packed[-1] += 1
        else:
            packed += [at, 1]
    return packed


def _keys(records: Sequence[Record]) -> Data:
    """Return the columns used by filters, and the identities used by links."""
    shown: dict[str, Callable[[Record], str]] = {
        "case": lambda r: clean(r.case),
        "tol": lambda r: tolerance(r.tol),
        "solver": lambda r: clean(r.solver, 40),
        "status": lambda r: VERDICTS[r.status][1],
    }
    keys = {name: _coded([show(r) for r in records]) for name, show in shown.items()}
    return {"id": [short(r.identity) for r in records], **keys}


def _coded(values: Sequence[str]) -> Data:
    different = {v: i for i, v in enumerate(dict.fromkeys(values))}
    return {"values": list(different), "at": [different[v] for v in values]}


def _column(values: Sequence[Any]) -> Any:
    """Dictionary-encode a column if few values are distinct; 1, 1.0 and True are."""
    tables = {
        id(v): v for v in values if type(v) in (dict, list)
    }  # many records share one object
    known = {place: json.dumps(v) for place, v in tables.items()}
    keys = [known.get(id(v)) or (type(v), v) for v in values]
    first = dict(zip(reversed(keys), reversed(values), strict=True))
    if 2 * len(first) > len(values):
        return list(values)
    different = {key: i for i, key in enumerate(first)}
    return {"values": [*first.values()], "at": [different[key] for key in keys]}
