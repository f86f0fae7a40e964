"""Files of lines, such as a journal: appended to line by line, read within bounds.

Such a file holds whole lines and at most one partial line at the end, which counts for
nothing: readers skip it, the next writer cuts it off.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Self

from mortarbench.harness.digest import Digest, running_digest
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.datafile import opened
from mortarbench.harness.files.durable import replace_file, sync_folder

LONGEST_LINE = 2**24  #: bytes
_CHUNK = 2**16


def read_lines(path: Path, expected: str) -> Iterator[bytes]:
    """Read the whole lines of a file one by one, each with its newline.

    expected : what would be right, for messages, e.g. "a journal"

    Raises
    ------
    InputError
        When the file is not a regular one, is larger than `harness.files.datafile`
        allows, or has a line above `LONGEST_LINE`.

    """
    with opened(path, expected) as file:
        for number in count(1):
            line = file.readline(LONGEST_LINE)
            if line.endswith(b"\n"):
                yield line
            elif len(line) < LONGEST_LINE:
                return
            else:
                raise InputError(
                    f"{path}, line {number}: longer than {LONGEST_LINE >> 20} MiB; "
                    f"expected {expected}, as a run appends it"
                )


class Lines:
    """The writer's end of a file of lines, of which nobody else writes.

    A digest of the content runs along, so that a line which another program edits in
    place is noticed: whenever the times of the file are not those of our last write,
    and at the end. The digest is in memory only; between two runs lines may be edited.

    restored : called with a line of text when the file had to be written again
    """

    def __init__(self, path: Path, restored: Callable[[str], None]) -> None:
        self._path = path
        self._restored = restored
        path.parent.mkdir(parents=True, exist_ok=True)
        self._open()

    def append(self, text: str) -> None:
        """Write one line and return when it is on the disk, or raise and write none.

        Raises
        ------
        InputError
            When something else writes to the file.
        OSError
            When the disk is full, say.

        """
        self.restore()
        whole = f"{text}\n".encode()
        line = memoryview(whole)
        try:
            while line:  # a write to a disk that is nearly full may be short
                line = line[os.write(self._fd, line) :]
            os.fsync(self._fd)
        except OSError:
            os.ftruncate(self._fd, self._end)
            raise
        self._end += len(whole)
        self._digest.update(whole)
        self._times = _times(os.fstat(self._fd))

    def restore(self) -> None:
        """Write the file again if it was deleted or replaced since it was opened.

        All that was in it is in the file that we hold open, whatever its name leads to.
        Lines that a file in its place has and ours has not are kept.

        Raises
        ------
        InputError
            When the content of the file has been changed by something else.

        """
        held = os.fstat(self._fd)
        if (held.st_size, *_times(held)) != (self._end, *self._times):
            self._refuse_changed()
        with suppress(FileNotFoundError):
            if os.path.samestat(held, self._path.stat()):
                return
        there = [*read_lines(self._path, "lines")] if self._path.exists() else []
        known = set(there)
        mine = b"".join(self._chunks()).splitlines(keepends=True)
        lost = [line for line in mine if line not in known]
        replace_file(self._path, b"".join([*there, *lost]))
        os.close(self._fd)
        self._open()
        self._restored(
            f"{self._path} was deleted or replaced; its {len(lost)} "
            f"line{'s' * (len(lost) != 1)} that were missing are there again"
        )

    def _open(self) -> None:
        flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
        self._fd = os.open(self._path, flags, 0o666)
        self._end = _end_of_lines(self._fd)
        os.ftruncate(self._fd, self._end)
        self._times = _times(os.fstat(self._fd))  # an edit while it is read is noticed
        self._digest: Digest = running_digest(self._chunks())
        sync_folder(self._path.parent)

    def _refuse_changed(self) -> None:
        """Refuse a file whose content is not what we have read and written."""
        held = os.fstat(self._fd)
        is_same = held.st_size == self._end
        if is_same:
            found = running_digest(self._chunks())
            is_same = found.digest() == self._digest.digest()
        if not is_same:
            raise InputError(
                f"{self._path} was changed by another program while the run wrote it; "
                "the same command continues with what it holds now"
            )
        self._times = _times(held)  # touched, linked or deleted

    def _chunks(self) -> Iterator[bytes]:
        """Read the whole lines of the file that is held open."""
        start = 0
        while chunk := os.pread(self._fd, min(_CHUNK, self._end - start), start):
            yield chunk
            start += len(chunk)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        try:
            if error is None:  # an edit within the resolution of a file's times, too
                self._refuse_changed()
        finally:
            os.close(self._fd)


def _times(info: os.stat_result) -> tuple[int, int]:
    """Return the times at which content and anything else were changed last, ns."""
    return info.st_mtime_ns, info.st_ctime_ns


def _end_of_lines(fd: int) -> int:
    """Find the offset behind the last newline."""
    end = os.fstat(fd).st_size
    while end > 0:
        start = max(0, end - _CHUNK)
        newline = os.pread(fd, end - start, start).rfind(b"\n")
        if newline != -1:
            return start + newline + 1
        end = start
    return 0
