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

_TYPES = {"int": pa.int64(), "float": pa.float64()}  #: anything else is text


def write_records(path: Path, records: Sequence[Record]) -> Path:
    """Write one row per journal line, a column per field; equal records, equal bytes.

    The type of a column is that of the field, never guessed from the values, so that
    the tables of several result folders can be put under one another. What is nested
    (params, options, counts, quantities, …) differs between families and solvers, and
    is JSON text.
    """
    columns = {f.name: _kind(str(f.type)) for f in fields(Record)}
    rows = [json.loads(record.to_json()) for record in records]
    for row in rows:
        nested = {k: v for k, v in row.items() if isinstance(v, Mapping)}
        row |= {k: json.dumps(v, ensure_ascii=False) for k, v in nested.items()}
    table = pa.Table.from_pylist(rows, schema=pa.schema(columns))
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path, compression="zstd")
    return path


def _kind(annotation: str) -> Any:
    return _TYPES.get(annotation.removesuffix(" | None"), pa.string())
