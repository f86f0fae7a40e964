"""Storage of the data of an experiment in plain files, readable without this package.

::

    FOLDER/setting.json     setting, names of the tables, digests of the states
    FOLDER/NAME.csv         one table, with a row per measurement
    FOLDER/vectors/*.npz    deformed states
"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mortarbench.harness.errors import InputError
from mortarbench.harness.files.csvfile import csv_text
from mortarbench.harness.files.durable import replace_file
from mortarbench.harness.files.reading import read_json
from mortarbench.harness.files.store import load_fields, save_fields
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


def save_experiment(experiment: Experiment, folder: Path) -> None:
    """Write the data of an experiment to the files listed in the module docstring."""
    folder.mkdir(parents=True, exist_ok=True)
    states = {name: save_fields(folder, f) for name, f in experiment.states.items()}
    for name, rows in experiment.tables.items():
        heads = list(rows[0])
        text = csv_text(heads, ([row[head] for head in heads] for row in rows))
        replace_file(folder / f"{name}.csv", text.encode())
    setting = {
        "setting": experiment.setting,
        "tables": list(experiment.tables),
        "states": states,
    }
    text = json.dumps(setting, indent=1, ensure_ascii=False) + "\n"
    replace_file(folder / "setting.json", text.encode())


def load_experiment(folder: Path) -> Experiment:
    """Read the files that `save_experiment` wrote; numbers are restored exactly.

    Raises
    ------
    InputError
        If a file is missing or damaged.

    """
    path = folder / "setting.json"
    try:
        index = read_json(path)
        tables = {name: _read_csv(folder / f"{name}.csv") for name in index["tables"]}
        setting, digests = dict(index["setting"]), dict(index["states"])
    except OSError as e:
        raise InputError(f"{e.filename}: cannot be read: {e.strerror}") from None
    except (ValueError, KeyError, TypeError) as e:
        raise InputError(f"{path}: not the setting of an experiment: {e}") from None
    states = {name: load_fields(folder, digest) for name, digest in digests.items()}
    return Experiment(setting=setting, tables=tables, states=states)


def _read_csv(path: Path) -> list[Row]:
    with path.open(encoding="utf-8", newline="") as file:
        return [
            {key: _value(text) for key, text in row.items()}
            for row in csv.DictReader(file)
        ]


def _value(text: str) -> Value:
    """Convert a text to an integer or a float if possible, or return it unchanged."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
