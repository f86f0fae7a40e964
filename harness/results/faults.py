"""Faults of ours or of the machine: ``FOLDER/faults.jsonl``, never the journal.

A fault prevents a measurement and says nothing of the solver. Each is one line, written
like the journal's; the measurement counts as not made until the journal holds it, and
the same command makes it.
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
    "time": str, "run_id": str, "case": str, "solver": str, "what": str,
    "tried_again": bool,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Fault:
    """What prevented a measurement once."""

    time: str  #: UTC, ISO 8601
    run_id: str  #: of the measurement that was to be made
    case: str  #: canonical name
    solver: str  #: its label
    what: str  #: one line
    tried_again: bool  #: by the same run, at once; False: it was left

    def to_json(self) -> str:
        """Serialise to one line."""
        return json.dumps(asdict(self))


def read_faults(folder: Path) -> list[Fault]:
    """Read the faults of a result folder; none where there is no file.

    Raises
    ------
    InputError
        When a line other than a partial last one is damaged, or the file is none that
        `harness.files.lines.read_lines` takes.

    """
    path = folder / FAULTS
    if not os.path.lexists(path):
        return []
    lines = read_lines(path, "the faults of a result folder")
    return [_parsed(line, path, number) for number, line in enumerate(lines, 1)]


def remaining_faults(faults: Iterable[Fault], made: Iterable[str]) -> list[Fault]:
    """Choose the last fault of each measurement that is not `made`, by run_id."""
    last = {fault.run_id: fault for fault in faults}
    for run_id in made:
        last.pop(run_id, None)
    return list(last.values())


def in_words(faults: Iterable[Fault]) -> str:
    """Say how many measurements could not be made, and why; "" if all could."""
    every = list(faults)
    if not every:
        return ""
    reasons = some(dict.fromkeys(fault.what for fault in every))
    count = f"{len(every)} measurement{'s' * (len(every) != 1)}"
    return f"{count} could not be made, by no fault of a solver: {reasons}"


def _parsed(line: bytes, path: Path, number: int) -> Fault:
    try:
        row: Any = json.loads(line)
        given = {name: row[name] for name in _TYPES}
    except (ValueError, TypeError, KeyError, RecursionError):
        given = {}
    if not given or any(type(given[k]) is not kind for k, kind in _TYPES.items()):
        raise InputError(
            f"{path}, line {number}: damaged; expected a JSON object with "
            f"{', '.join(_TYPES)}, as a run appends it; the line may be deleted"
        )
    return Fault(**given)
