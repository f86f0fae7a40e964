"""Journal of a result folder: append-only, with one fsynced line per measurement.

If a process is killed while it writes, the journal ends with a partial line. Readers
ignore the partial line, and the next writer removes it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from mortarbench.harness.errors import InputError, shown, some
from mortarbench.harness.files.lines import Lines, read_lines
from mortarbench.harness.record import Record
from mortarbench.harness.results.folder import refuse_links


class Journal:
    """Writer of a file ``FOLDER/journal/NAME.jsonl``.

    The folder must be locked by `harness.results.folder.lock_folder` while the writer
    is open, because a second writer could truncate an incomplete line. All files of the
    journal are kept open, so that a file can be restored if it is deleted.

    restored : called with a message of one line if a file was restored
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        restored: Callable[[str], None] = lambda _: None,
    ) -> None:
        own = folder / "journal" / f"{name}.jsonl"
        others = sorted({*own.parent.glob("*.jsonl")} - {own})
        self._files = ExitStack()
        self._own, *self._others = (
            self._files.enter_context(Lines(path, restored)) for path in (own, *others)
        )

    def append(self, record: Record) -> None:
        """Append a record, and flush its line to the disk.

        If an error occurs, the journal does not change.

        Raises
        ------
        InputError
            If another program writes to the journal.
        OSError
            If writing fails, for instance on a full disk.

        """
        self.restore()
        self._own.append(record.to_json())

    def restore(self) -> None:
        """Restore files that were deleted since they were opened.

        Raises
        ------
        InputError
            If another program writes to the journal.

        """
        for file in (self._own, *self._others):
            file.restore()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        self._files.__exit__(*error)


def read_journal(
    folder: Path, tell: Callable[[str], None] = lambda _: None
) -> list[Record]:
    """Read all records of a result folder, in the order of file names and lines.

    Every measurement, which session and run_id identify, occurs once in the result: a
    line is skipped if its record equals an earlier record. Equal strings and tables of
    different records in one file are stored only once in memory.

    tell : called with a message of one line if lines are skipped

    Raises
    ------
    InputError
        If the folder or its journal is missing; if the folder contains a link; if a
        line is damaged, except for an incomplete last line of a file; or if two
        different records have the same session and run_id.

    """
    if not os.path.isdir(folder):
        wrong = "a file" if os.path.exists(folder) else "no such folder"
        raise InputError(f"{folder}: {wrong}; expected a result folder")
    refuse_links(folder)
    paths = sorted((folder / "journal").glob("*.jsonl"))
    if not paths:
        raise InputError(f"no journal in {folder}; expected journal/*.jsonl there")
    records: list[Record] = []
    at: dict[str, int] = {}  # index in the result by identity
    repeated = []
    for path in paths:
        for number, record in _records(path):
            first = at.setdefault(record.identity, len(records))
            if first == len(records):
                records.append(record)
                continue
            repeated.append(f"{path}, line {number}")
            if record != records[first]:
                place = next(
                    f"{path}, line {number}"
                    for path in paths
                    for number, other in _records(path)
                    if other.identity == record.identity
                )
                raise InputError(
                    f"{repeated[-1]}: the record of run_id {shown(record.run_id)} "
                    f"differs from the record at {place}; expected one line per "
                    "run_id and session; delete the wrong line"
                )
    if repeated:
        lines = "line repeats" if len(repeated) == 1 else "lines repeat"
        tell(
            f"{len(repeated)} journal {lines} an earlier line exactly, and count "
            f"once: {some(repeated)}"
        )
    return records


def _records(path: Path) -> Iterator[tuple[int, Record]]:
    """Yield the line number and the record of each line of a file."""
    shared: dict[Any, Any] = {}
    for number, line in enumerate(read_lines(path, "a journal"), 1):
        try:
            yield number, Record.from_json(line, shared)
        except ValueError as e:
            raise InputError(
                f"{path}, line {number}: {e}, as written by a run; restore the file, "
                "or delete the line and run again"
            ) from None
