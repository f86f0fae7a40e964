"""Data of an experiment, from which the page of the paper is composed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mortarbench.harness.keys import Value
from mortarbench.harness.plugin import Fields

Row = Mapping[str, Value]


@dataclass(frozen=True, eq=False, kw_only=True)
class Experiment:
    """Tables of measurements, deformed states, and the setting of an experiment."""

    #: setting of the experiment as plain data that JSON can represent
    setting: Mapping[str, Any]
    #: rows of each table, at least one, by the name of the table; all rows of a table
    #: have the same keys
    tables: Mapping[str, Sequence[Row]]
    states: Mapping[str, Fields]  #: deformed states by name
