"""Measurements as Parquet and CSV tables, for pandas, R, DuckDB and spreadsheets."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from mortarbench.harness.files.csvfile import safe
from mortarbench.harness.files.durable import replacing
from mortarbench.harness.results.frame import with_texts

#: Parquet types by type of the column; all other columns are text
_TYPES = {
    "Int64": pa.int64(),
    "int64": pa.int64(),
    "float64": pa.float64(),
    "boolean": pa.bool_(),
    "bool": pa.bool_(),
}


def plain(df: pd.DataFrame) -> pd.DataFrame:
    """Return the measurements with columns of numbers and texts only.

    There is one more column for each key of a case. Nested values (params, options,
    counts, quantities, …) are JSON text, since they differ between families and
    solvers.
    """
    return with_texts(with_keys(df))


def write_parquet(path: Path, frame: pd.DataFrame) -> Path:
    """Write a frame of `plain`.

    The types of columns do not depend on values, so that tables of several result
    folders can be concatenated. Equal frames yield identical bytes.
    """
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


def write_csv(path: Path, frame: pd.DataFrame) -> Path:
    """Write a frame of `plain` as CSV that is safe to open in spreadsheets."""
    texts = frame.loc[:, [str(t) not in _TYPES for t in frame.dtypes]]
    frame = frame.assign(**texts.map(safe, na_action="ignore")).rename(columns=safe)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        frame.to_csv(file, index=False, lineterminator="\n", chunksize=1000)
    return path


def with_keys(df: pd.DataFrame) -> pd.DataFrame:
    """Add a column KEY, or key_KEY if the name is taken, for each key of the cases."""
    keys = pd.DataFrame(list(df.params), index=df.index)
    for name in keys:
        values = keys[name]
        if values.dtype == object and values.dropna().map(type).nunique() > 1:
            values = values.map(lambda v: None if v is None else str(v))
        df = df.assign(**{f"key_{name}" if name in df else str(name): values})
    return df
