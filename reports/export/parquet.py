"""The journal as a Parquet table with typed columns, for pandas, R, DuckDB etc."""

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

#: types of numeric columns; all other columns are text
_TYPES = {"int": pa.int64(), "float": pa.float64()}


def write_records(path: Path, records: Sequence[Record]) -> Path:
    """Write one row per journal line and one column per field.

    A column has the type of its field, not a type inferred from its values, so that
    tables of several result folders can be concatenated. Nested values (params,
    options, counts, quantities, …) are JSON text, since they differ between families
    and solvers. Equal records yield identical bytes.
    """
    table = pa.table(
        {
            name: _column([getattr(r, f.name) for r in records], str(f.type))
            for name, f in JOURNAL.items()
        }
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        pq.write_table(table, file, compression="zstd")
    return path


def _column(values: Sequence[Any], annotation: str) -> Any:
    """Return a column as in the journal: null if not finite, JSON text if nested."""
    kind = _TYPES.get(annotation.removesuffix(" | None"), pa.string())
    if kind is _TYPES["float"]:
        array = pa.array(values, kind)
        return pc.if_else(pc.is_finite(array), array, pa.scalar(None, kind))
    return pa.array(values if kind is _TYPES["int"] else texts(values), kind)


def texts(values: Iterable[Any]) -> list[str | None]:
    """Convert values to text: nested values to JSON, other values by `str`."""
    # cached by identity, because records of a journal share objects
    json_of: dict[int, str] = {}

    def text(value: Any) -> str | None:
        if value is None or type(value) is str:
            return value
        if not isinstance(value, Mapping | list):
            return str(value)  # a verdict
        if id(value) not in json_of:
            json_of[id(value)] = json.dumps(finite(value), ensure_ascii=False)
        return json_of[id(value)]

    return list(map(text, values))
