"""The journal as a table with typed columns, for pandas, R, DuckDB and the like."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from harness import Record
from harness.record import finite

_TYPES = {"int": pa.int64(), "float": pa.float64()}  #: anything else is text


def write_records(path: Path, records: Sequence[Record]) -> Path:
    """Write one row per journal line, a column per field; equal records, equal bytes.

    The type of a column is that of the field, never guessed from the values, so that
    the tables of several result folders can be put under one another. What is nested
    (params, options, counts, quantities, …) differs between families and solvers, and
    is JSON text.
    """
    columns = {f.name: _kind(str(f.type)) for f in fields(Record)}
    table = pa.table({
        name: pa.array([_entry(getattr(r, name)) for r in records], kind)
        for name, kind in columns.items()
    })  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path, compression="zstd")
    return path


def _entry(value: Any) -> Any:
    """Store as in the journal: what is not finite is null, what is nested is text."""
    value = finite(value)
    if isinstance(value, Mapping):
        return json.dumps(value, ensure_ascii=False)
    return str(value) if isinstance(value, str) else value  # a verdict, plainly


def _kind(annotation: str) -> Any:
    return _TYPES.get(annotation.removesuffix(" | None"), pa.string())
