"""Measurements as a data frame: a row per record, and a column per field of `Record`.

`mortarbench.results`, CSV and Parquet use the same columns.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, get_type_hints

import pandas as pd

from mortarbench.harness.record import Record, finite

#: types of columns of numbers and truth values, which may be missing; the values of
#: other columns are objects
_TYPES = {int: "Int64", float: "float64", bool: "boolean"}


def frame_of(records: Sequence[Record]) -> pd.DataFrame:
    """Return a row per record; the annotations of `Record` define names and types.

    Texts, verdicts and tables remain the objects of the records.
    """
    hints = get_type_hints(Record)
    return pd.DataFrame(
        {
            name: pd.Series(
                [getattr(r, name) for r in records], dtype=_type(hints[name])
            )
            for name in Record.__struct_fields__
        }
    )


def _type(hint: Any) -> str:
    return next(
        (t for kind, t in _TYPES.items() if hint in (kind, kind | None)), "object"
    )


def with_texts(frame: pd.DataFrame) -> pd.DataFrame:
    """Replace tables by JSON text, and verdicts by their values."""
    objects = frame.loc[:, frame.dtypes == "object"]
    return frame.assign(**objects.apply(_texts))


def _texts(values: pd.Series[Any]) -> pd.Series[Any]:
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

    return pd.Series(list(map(text, values)), dtype=object)
