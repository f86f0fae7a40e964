"""The journal of a result folder: one fsynced line per measurement, only ever appended.

A process may die at any instant. What it leaves behind is whole lines and at most one
partial line at the end, which counts for nothing: readers skip it, the next writer cuts
it off.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from json import JSONDecodeError
from pathlib import Path
from types import TracebackType
from typing import Self

from harness.durable import Lines
from harness.errors import InputError
from harness.folder import refuse_links
from harness.record import Record


class Journal:
    """The writer's end of one file ``FOLDER/journal/NAME.jsonl``.

    Hold `harness.folder.locked` while one is open: a second writer could cut off a line
    that this one is writing. Whatever files there are beside it are held open, too, so
    that a journal that is deleted meanwhile can be written again.

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
        for file in self._others:
            file.restore()
        self._own.append(record.to_json())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._files.close()


def read_journal(folder: Path) -> list[Record]:
    """Read every record of a result folder, file by file in the order of their names.

    Raises
    ------
    InputError
        When there is no folder, no journal, a link in the folder, or a line other than
        a partial last one is bad.

    """
    if not folder.is_dir():
        wrong = "a file" if folder.exists() else "no such folder"
        raise InputError(f"{folder}: {wrong}; expected a result folder")
    refuse_links(folder)
    paths = sorted((folder / "journal").glob("*.jsonl"))
    if not paths:
        raise InputError(f"no journal in {folder}; expected journal/*.jsonl there")
    return [record for path in paths for record in _records(path)]


def _records(path: Path) -> Iterator[Record]:
    for number, line in enumerate(_whole_lines(path.read_bytes()).splitlines(), 1):
        try:
            yield Record.from_json(line.decode())
        except (JSONDecodeError, UnicodeDecodeError):
            raise InputError(
                f"{path}, line {number}: damaged; expected a JSON object, as a run "
                "appends it; restore the file, or delete the line and run again"
            ) from None
        except ValueError as e:
            raise InputError(f"{path}, line {number}: {e}") from None


def _whole_lines(text: bytes) -> bytes:
    """Drop what follows the last newline."""
    return text[: text.rfind(b"\n") + 1]
