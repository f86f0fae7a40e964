"""The journal of a result folder: one fsynced line per measurement, only ever appended.

A process may die at any instant. What it leaves behind is whole lines and at most one
partial line at the end, which counts for nothing: readers skip it, the next writer cuts
it off.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from json import JSONDecodeError
from pathlib import Path
from typing import Any, Self

from mortarbench.harness.errors import InputError, shown, some
from mortarbench.harness.files.lines import Lines, read_lines
from mortarbench.harness.record import Record
from mortarbench.harness.results.folder import refuse_links


class Journal:
    """The writer's end of one file ``FOLDER/journal/NAME.jsonl``.

    Hold `harness.results.folder.lock_folder` while one is open: a second writer could
    cut off a line that this one is writing. Whatever files there are beside it are held
    open, too, so that a journal that is deleted meanwhile can be written again.

    restored : told in a line when that was necessary
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
        """Write one line and return when it is on the disk, or raise and write none.

        Raises
        ------
        InputError
            When another program writes to the journal.
        OSError
            When the disk is full, say.

        """
        self.restore()
        self._own.append(record.to_json())

    def restore(self) -> None:
        """Write files again that were deleted since they were opened.

        Raises
        ------
        InputError
            When another program writes to the journal.

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
    """Read every record of a result folder, file by file in the order of their names.

    Every run_id is there once: a line that repeats another one, field by field, is left
    out. Equal texts and tables of different records are one in memory.

    tell : is told, in a line, how many lines were left out

    Raises
    ------
    InputError
        When there is no folder, no journal, a link in the folder, when a line other
        than a partial last one is bad, or when two lines tell different things of one
        run_id.

    """
    if not os.path.isdir(folder):
        wrong = "a file" if os.path.exists(folder) else "no such folder"
        raise InputError(f"{folder}: {wrong}; expected a result folder")
    refuse_links(folder)
    paths = sorted((folder / "journal").glob("*.jsonl"))
    if not paths:
        raise InputError(f"no journal in {folder}; expected journal/*.jsonl there")
    records: list[Record] = []
    at: dict[str, int] = {}  # run_id → index
    repeated = []
    for path in paths:
        for number, record in _records(path):
            first = at.setdefault(record.run_id, len(records))
            if first == len(records):
                records.append(record)
                continue
            repeated.append(f"{path}, line {number}")
            if record != records[first]:
                place = next(
                    f"{path}, line {number}"
                    for path in paths
                    for number, other in _records(path)
                    if other.run_id == record.run_id
                )
                raise InputError(
                    f"{repeated[-1]}: tells of run_id {shown(record.run_id)} another "
                    f"thing than {place}; expected one line for each; delete the one "
                    "that is wrong"
                )
    if repeated:
        lines = "line is" if len(repeated) == 1 else "lines are"
        tell(
            f"{len(repeated)} journal {lines} there before, word for word, and left "
            f"out: {some(repeated)}"
        )
    return records


def _records(path: Path) -> Iterator[tuple[int, Record]]:
    """Read the records of one file with the numbers of their lines."""
    shared: dict[Any, Any] = {}
    for number, line in enumerate(read_lines(path, "a journal"), 1):
        try:
            yield number, Record.from_json(line, shared)
        except (JSONDecodeError, UnicodeDecodeError):
            raise InputError(
                f"{path}, line {number}: damaged; expected a JSON object, as a run "
                "appends it; restore the file, or delete the line and run again"
            ) from None
        except ValueError as e:
            raise InputError(f"{path}, line {number}: {e}") from None
