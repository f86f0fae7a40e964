"""Faults of the harness or the machine, in ``FOLDER/faults.jsonl``.

A fault prevents a measurement, but implies nothing about the solver. Faults are
therefore written to a separate file instead of the journal, with a JSON object on each
line. The measurement counts as missing until its record is in the journal. If the same
run command is given again, the new run repeats missing measurements.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mortarbench.harness.errors import InputError, some
from mortarbench.harness.files.lines import read_lines

FAULTS = "faults.jsonl"

_TYPES: dict[str, type] = {
    "time": str,
    "run_id": str,
    "case": str,
    "solver": str,
    "what": str,
    "tried_again": bool,
}


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A failure of the harness or the machine that prevented a measurement."""

    time: str  #: time of the fault, UTC, ISO 8601
    run_id: str  #: run_id of the prevented measurement
    case: str  #: canonical name
    solver: str  #: label of the solver
    what: str  #: reason of the fault in one line
    tried_again: bool  #: True if the same run repeated the measurement after the fault

    def to_json(self) -> str:
        """Return the fault as one line of JSON."""
        return json.dumps(asdict(self))


def read_faults(folder: Path) -> list[Fault]:
    """Read the faults of a result folder; return [] if the file is missing.

    Raises
    ------
    InputError
        If a line is damaged, except for an incomplete last line, or if
        `harness.files.lines.read_lines` refuses the file.

    """
    path = folder / FAULTS
    if not os.path.lexists(path):
        return []
    lines = read_lines(path, "the faults of a result folder")
    return [_parsed(line, path, number) for number, line in enumerate(lines, 1)]


def remaining_faults(faults: Iterable[Fault], measured: Iterable[str]) -> list[Fault]:
    """Return the last fault of each measurement that is still missing.

    measured : run_ids of the measurements that are in the journal
    """
    last = {fault.run_id: fault for fault in faults}
    for run_id in measured:
        last.pop(run_id, None)
    return list(last.values())


def in_words(faults: Iterable[Fault]) -> str:
    """Return a sentence with the number of faults and their reasons, or ""."""
    faults = list(faults)
    if not faults:
        return ""
    reasons = some(dict.fromkeys(fault.what for fault in faults))
    count = f"{len(faults)} measurement{'s' * (len(faults) != 1)}"
    return f"{count} failed for reasons other than the solver: {reasons}"


def _parsed(line: bytes, path: Path, number: int) -> Fault:
    try:
        row: Any = json.loads(line)
        fields = {name: row[name] for name in _TYPES}
    except (ValueError, TypeError, KeyError, RecursionError):
        fields = {}
    if not fields or any(type(fields[k]) is not kind for k, kind in _TYPES.items()):
        raise InputError(
            f"{path}, line {number}: damaged; expected a JSON object with "
            f"{', '.join(_TYPES)}, as written by a run; you can delete this line"
        )
    return Fault(**fields)
