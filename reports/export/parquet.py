"""The journal as a Parquet table with typed columns, for pandas, R, DuckDB etc."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from mortarbench.harness import Record
from mortarbench.harness.files.durable import replacing
from mortarbench.harness.results.frame import frame_of, with_texts

#: Parquet types by type of the column; all other columns are text
_TYPES = {"Int64": pa.int64(), "float64": pa.float64(), "boolean": pa.bool_()}


def write_records(path: Path, records: Sequence[Record]) -> Path:
    """Write the table of `harness.results.frame` with a schema that is always equal.

    The types of columns do not depend on values, so that tables of several result
    folders can be concatenated. Nested values (params, options, counts, quantities, …)
    are JSON text, since they differ between families and solvers. Equal records yield
    identical bytes.
    """
    frame = with_texts(frame_of(records))
    table = pa.table(
        {
            name: pa.array(
                frame[name], _TYPES.get(str(dtype), pa.string()), from_pandas=True
            )
            for name, dtype in frame.dtypes.items()
        }
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        pq.write_table(table, file, compression="zstd")
    return path
