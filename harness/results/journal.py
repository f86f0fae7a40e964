"""Journal of a result folder: append-only, with one fsynced line per measurement.

If a process is killed while it writes, the journal ends with a partial line. Readers
ignore the partial line, and the next writer removes it. Readers limit the size of a
file and the length of its lines.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import count
from pathlib import Path
from typing import Any, Self

from mortarbench.harness.errors import InputError, shown
from mortarbench.harness.files.durable import sync_folder
from mortarbench.harness.files.reading import opened
from mortarbench.harness.record import Record
from mortarbench.harness.results.folder import refuse_links

#: length of the longest line that is read, which bounds the required memory
MAX_LINE_BYTES = 2**24


class Journal:
    """Writer of a file ``FOLDER/journal/NAME.jsonl``.

    The folder must be locked by `harness.results.folder.lock_folder` while the writer
    is open, because a second writer could truncate an incomplete line.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self._path = folder / "journal" / f"{name}.jsonl"
        self._path.parent.mkdir(parents=True, exist_ok=True)
        lines = read_lines(self._path) if self._path.exists() else ()
        self._size = sum(map(len, lines))  #: number of bytes of whole lines
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
        self._fd = os.open(self._path, flags, 0o666)
        os.ftruncate(self._fd, self._size)
        sync_folder(self._path.parent)

    def append(self, record: Record) -> None:
        """Append a record, and flush its line to the disk.

        If an error occurs, the journal does not change.

        Raises
        ------
        InputError
            If `check` refuses the file.
        OSError
            If writing fails, for instance on a full disk.

        """
        self.check()
        whole = f"{record.to_json()}\n".encode()
        line = memoryview(whole)
        try:
            while line:  # if the disk is nearly full, a write may be incomplete
                line = line[os.write(self._fd, line) :]
            os.fsync(self._fd)
        except OSError:
            os.ftruncate(self._fd, self._size)
            raise
        self._size += len(whole)

    def check(self) -> None:
        """Check that no other program has moved, deleted or changed the file.

        Raises
        ------
        InputError
            If the file is not at its path, or has another size.

        """
        held = os.fstat(self._fd)
        if (
            self._path.is_file()
            and os.path.samestat(self._path.stat(), held)
            and held.st_size == self._size
        ):
            return
        raise InputError(
            f"{self._path} was moved, deleted or changed during the run; the same "
            "command continues with the lines that are there"
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        os.close(self._fd)


def read_lines(path: Path) -> Iterator[bytes]:
    """Yield the whole lines of a journal, each with its newline.

    Raises
    ------
    InputError
        If the file is not a regular file, is larger than `harness.files.reading`
        allows, or has a line longer than `MAX_LINE_BYTES`.

    """
    with opened(path, "a journal") as file:
        for number in count(1):
            line = file.readline(MAX_LINE_BYTES)
            if line.endswith(b"\n"):
                yield line
            elif len(line) < MAX_LINE_BYTES:
                return
            else:
                raise InputError(
                    f"{path}, line {number}: longer than {MAX_LINE_BYTES >> 20} MiB; "
                    "expected a journal written by a run"
                )


def read_journal(
    folder: Path, tell: Callable[[str], None] = lambda _: None
) -> list[Record]:
    """Read all records of a result folder, in the order of file names and lines.

    A line that equals an earlier line is skipped. Equal texts and tables of different
    records in one file are stored only once in memory.

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
    records: dict[str, Record] = {}
    repeated = 0
    for path in paths:
        for number, record in _records(path):
            first = records.setdefault(record.identity, record)
            repeated += first is not record
            if first != record:
                raise InputError(
                    f"{path}, line {number}: differs from an earlier record of run_id "
                    f"{shown(record.run_id)}; expected one line per run_id and "
                    "session; delete the wrong line"
                )
    if repeated:
        lines = "line repeats" if repeated == 1 else "lines repeat"
        tell(f"{repeated} journal {lines} an earlier line exactly, and count once")
    return [*records.values()]


def check_labels(
    where: str,
    records: Iterable[Record],
    labels: dict[str, tuple[str, Mapping[str, Any]]],
) -> None:
    """Refuse records whose label denotes another solver, or other options.

    where : folder of the records, for the message
    labels : name and options of the solver that each label denotes; a label of
        `records` that is missing is added

    Raises
    ------
    InputError
        If a solver differs, or an option that both have.

    """
    for r in records:
        name, options = labels.setdefault(r.solver, (r.method, r.options))
        now = {**options, "name": name}
        for key, old in {**r.options, "name": r.method}.items():
            if now.get(key, old) != old:
                raise InputError(
                    f"{where} contains {r.solver} with {key} = {shown(old)}, now "
                    f"{shown(now[key])}; use a different label for other options"
                )


def _records(path: Path) -> Iterator[tuple[int, Record]]:
    """Yield the line number and the record of each line of a file."""
    shared: dict[str, Any] = {}
    for number, line in enumerate(read_lines(path), 1):
        try:
            yield number, Record.from_json(line, shared)
        except ValueError as e:
            raise InputError(
                f"{path}, line {number}: {e}, as written by a run; restore the file, "
                "or delete the line and run again"
            ) from None
