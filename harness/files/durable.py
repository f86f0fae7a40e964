"""Atomic replacement of files, and messages for full disks.

A process may be killed at any time, and a disk may become full at any time. After
either event, a file that was being replaced contains either its old content or its
complete new content. For files that grow line by line, see `harness.files.lines`.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from secrets import token_hex
from typing import IO

from mortarbench.harness.errors import InputError

#: pattern of the names of files that are not yet complete
_UNFINISHED = ".mortarbench-*.tmp"

#: error numbers of a full disk, an exhausted quota and an exceeded file size limit
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_PROBE_BYTES = 2**16  #: number of bytes that are written to test whether a disk is full


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Open a new file that replaces `path` at the end of the block.

    The new file is flushed to the disk before it is renamed, so that after a crash
    `path` is either the old file or the complete new one. Processes that have opened or
    mapped the old file continue to see the old content.
    """
    new = path.with_name(_UNFINISHED.replace("*", token_hex(8)))
    try:
        with new.open("x+b") as file:
            yield file
            # without this flush, a crash after the rename could leave an empty file
            file.flush()
            os.fsync(file.fileno())
            os.replace(new, path)
            sync_folder(path.parent)
    finally:
        new.unlink(missing_ok=True)


@contextmanager
def writing(path: Path) -> Iterator[IO[bytes]]:
    """Open a new file with `replacing`; raise InputError if it cannot be written."""
    try:
        with replacing(path) as file:
            yield file
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror or e}") from None


def replace_file(path: Path, content: bytes) -> None:
    """Write `content` to a file with `replacing`; missing folders are created."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        file.write(content)


def remove_unfinished(folder: Path, own: Iterable[Path]) -> None:
    """Delete incomplete files that killed processes left in a result folder.

    No process may be writing to the folder.

    own : subfolders that contain only files of this package
    """
    inside = (path for one in own for path in one.rglob(_UNFINISHED))
    for path in (*folder.glob(_UNFINISHED), *inside):
        path.unlink(missing_ok=True)


@contextmanager
def report_full_disk(folder: Path) -> Iterator[None]:
    """Convert an OSError for a full disk, raised in the block, to an InputError.

    folder : folder to which the block writes

    Raises
    ------
    InputError
        If the disk is full, a quota is exhausted or a file size limit is reached; the
        message names a remedy.

    """
    try:
        yield
    except OSError as e:
        if e.errno not in FULL:
            raise
        raise InputError(_full(folder, e.errno)) from e


def refuse_full_disk(folder: Path, failure: str) -> None:
    """Raise if a failure was caused by a full disk.

    folder : folder to which the failed operation wrote
    failure : message of the failure

    Raises
    ------
    InputError
        If `failure` reports a full disk, or the disk is full now; the message names a
        remedy.

    """
    for code in FULL:
        if os.strerror(code) in failure:
            raise InputError(_full(folder, code))
    with report_full_disk(folder):
        path = folder / _UNFINISHED.replace("*", token_hex(8))
        try:
            # raised if the folder does not exist
            with suppress(FileNotFoundError), path.open("xb") as file:
                file.write(bytes(_PROBE_BYTES))
        finally:
            path.unlink(missing_ok=True)


def _full(path: Path, code: int) -> str:
    """Return the error message for a full file system.

    code : error number, one of `FULL`
    """
    return (
        f"{path} cannot be written: {os.strerror(code)}; free some space; the same "
        "command continues the run"
    )


def sync_folder(folder: Path) -> None:
    """Flush the directory entries of a folder to the disk, with fsync."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
