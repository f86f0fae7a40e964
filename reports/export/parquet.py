"""The journal as a table with typed columns, for pandas, R, DuckDB and the like."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from mortarbench.harness import Record
from mortarbench.harness.files.durable import replacing
from mortarbench.harness.record import JOURNAL, finite

_TYPES = {"int": pa.int64(), "float": pa.float64()}  #: anything else is text


def write_records(path: Path, records: Sequence[Record]) -> Path:
    """Write one row per journal line, a column per field; equal records, equal bytes.

    The type of a column is that of the field, never guessed from the values, so that
    the tables of several result folders can be put under one another. What is nested
    (params, options, counts, quantities, …) differs between families and solvers, and
    is JSON text.
    """
    table = pa.table({
        name: _column([getattr(r, f.name) for r in records], str(f.type))
        for name, f in JOURNAL.items()
    })  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        pq.write_table(table, file, compression="zstd")
    return path


def _column(values: Sequence[Any], annotation: str) -> Any:
    """Store as in the journal: what is not finite is null, what is nested is text."""
    kind = _TYPES.get(annotation.removesuffix(" | None"), pa.string())
    if kind is _TYPES["float"]:
        array = pa.array(values, kind)
        return pc.if_else(pc.is_finite(array), array, pa.scalar(None, kind))
    return pa.array(values if kind is _TYPES["int"] else texts(values), kind)


def texts(values: Iterable[Any]) -> list[str | None]:
    """Write every value as text, what is nested as JSON; equal objects once."""
    known: dict[int, str] = {}  # by identity: a journal's records share their tables

    def text(value: Any) -> str | None:
        if value is None or type(value) is str:
            return value
        if not isinstance(value, Mapping | list):
            return str(value)  # a verdict, plainly
        if id(value) not in known:
            known[id(value)] = json.dumps(finite(value), ensure_ascii=False)
        return known[id(value)]

    return list(map(text, values))
