"""Files that grow line by line, such as a journal.

Such a file contains whole lines. If the writer was killed, the file may also contain a
partial last line. Readers skip the partial line, and the next writer removes it.
Readers limit the size of the file and the length of its lines.
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

#: length of the longest line that is read, which bounds the required memory
MAX_LINE_BYTES = 2**24
_CHUNK_BYTES = 2**16  #: number of bytes that are read at a time


def read_lines(path: Path, expected: str) -> Iterator[bytes]:
    """Yield the whole lines of a file, each with its newline.

    expected : description of the file, for messages, e.g. "a journal"

    Raises
    ------
    InputError
        If the file is not a regular file, is larger than `harness.files.datafile`
        allows, or has a line longer than `MAX_LINE_BYTES`.

    """
    with opened(path, expected) as file:
        for number in count(1):
            line = file.readline(MAX_LINE_BYTES)
            if line.endswith(b"\n"):
                yield line
            elif len(line) < MAX_LINE_BYTES:
                return
            else:
                raise InputError(
                    f"{path}, line {number}: longer than {MAX_LINE_BYTES >> 20} MiB; "
                    f"expected {expected} written by a run"
                )


class Lines:
    """Sole writer of a file of lines.

    The writer keeps a digest of the content in memory to detect edits by other
    programs. The digest is compared when the writer ends without an error, and before a
    line is appended if the time stamps of the file have changed since the last write.
    Edits between two runs are allowed.

    restored : called with a message after the file has been written again
    """

    def __init__(self, path: Path, restored: Callable[[str], None]) -> None:
        self._path = path
        self._restored = restored
        path.parent.mkdir(parents=True, exist_ok=True)
        self._open()

    def append(self, text: str) -> None:
        """Append a line and flush it to the disk; on error, leave the file unchanged.

        Raises
        ------
        InputError
            If another program has changed the content of the file.
        OSError
            If the line cannot be written, for instance because the disk is full.

        """
        self.restore()
        whole = f"{text}\n".encode()
        line = memoryview(whole)
        try:
            while line:  # if the disk is nearly full, a write may be incomplete
                line = line[os.write(self._fd, line) :]
            os.fsync(self._fd)
        except OSError:
            os.ftruncate(self._fd, self._end)
            raise
        self._end += len(whole)
        self._digest.update(whole)
        self._times = _times(os.fstat(self._fd))

    def restore(self) -> None:
        """Restore the file if it was deleted or replaced after it was opened.

        Missing lines are restored from the old content, to which the open descriptor
        still refers. Lines that only the replacement file contains are kept.

        Raises
        ------
        InputError
            If another program has changed the content of the file.

        """
        held = os.fstat(self._fd)
        if (held.st_size, *_times(held)) != (self._end, *self._times):
            self._refuse_changed()
        with suppress(FileNotFoundError):
            if os.path.samestat(held, self._path.stat()):
                return
        present = [*read_lines(self._path, "lines")] if self._path.exists() else []
        known = set(present)
        mine = b"".join(self._chunks()).splitlines(keepends=True)
        lost = [line for line in mine if line not in known]
        replace_file(self._path, b"".join([*present, *lost]))
        os.close(self._fd)
        self._open()
        self._restored(
            f"{self._path} was deleted or replaced; {len(lost)} missing "
            f"line{'s' * (len(lost) != 1)} restored"
        )

    def _open(self) -> None:
        flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
        self._fd = os.open(self._path, flags, 0o666)
        self._end = _end_of_lines(self._fd)
        os.ftruncate(self._fd, self._end)
        # Read the time stamps before the content, to detect edits while the digest is
        # computed.
        self._times = _times(os.fstat(self._fd))
        self._digest: Digest = running_digest(self._chunks())
        sync_folder(self._path.parent)

    def _refuse_changed(self) -> None:
        """Check that the file contains exactly the lines that were read and written."""
        held = os.fstat(self._fd)
        is_same = held.st_size == self._end
        if is_same:
            digest = running_digest(self._chunks())
            is_same = digest.digest() == self._digest.digest()
        if not is_same:
            raise InputError(
                f"{self._path} was changed by another program during the run; the "
                "same command continues with the present content of the file"
            )
        # the content is unchanged; the file was only touched, linked or deleted
        self._times = _times(held)

    def _chunks(self) -> Iterator[bytes]:
        """Yield the whole lines of the open file in chunks."""
        start = 0
        while chunk := os.pread(self._fd, min(_CHUNK_BYTES, self._end - start), start):
            yield chunk
            start += len(chunk)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        try:
            # Compare the content again, since an edit within the resolution of the time
            # stamps does not change the time stamps.
            if error is None:
                self._refuse_changed()
        finally:
            os.close(self._fd)


def _times(info: os.stat_result) -> tuple[int, int]:
    """Return the times of the last changes of content and status, in ns."""
    return info.st_mtime_ns, info.st_ctime_ns


def _end_of_lines(fd: int) -> int:
    """Return the offset after the last newline, or 0 if there is no newline."""
    end = os.fstat(fd).st_size
    while end > 0:
        start = max(0, end - _CHUNK_BYTES)
        newline = os.pread(fd, end - start, start).rfind(b"\n")
        if newline != -1:
            return start + newline + 1
        end = start
    return 0
