"""Files that outlive a crash: whole or not there, or line by line; and full disks.

A process may die, and a disk may be full, at any instant. A file that is replaced holds
either its old content or all of its new one. A file of lines holds whole lines and at
most one partial line at the end, which counts for nothing: readers skip it, the next
writer cuts it off.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from secrets import token_hex
from types import TracebackType
from typing import IO, Self

from harness.errors import InputError

_UNFINISHED = ".mortarbench-*.tmp"  #: what files are called until they are whole
_OTHERS = ("*.tmp", "*.new", ".*.new")  #: of older versions, and of a case being built
_OLD = ("suite.tmp", "environment.tmp")

#: of an OSError: the disk, or our share of it, takes no more
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_PROBE_BYTES = 2**16
_CHUNK = 2**16
_MIB = 2**20


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Open a new file that takes the place of `path` at the end of the block.

    It is on the disk by then. Whatever happens, `path` leads to what was there before
    or to all that was written; who has opened or mapped the old file keeps that.
    """
    with _unfinished(path, 0o666) as (new, file):
        yield file
        _sync(file)
        move_file(new, path)


def replace_file(path: Path, content: bytes | memoryview) -> None:
    """Write a file as `replacing` does; its folder is made if need be."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        file.write(content)


def keep_private(path: Path, content: bytes) -> None:
    """Write a file that only its owner can read, unless there is one.

    Of several processes that do so at once, one writes.
    """
    with _unfinished(path, 0o600) as (new, file):
        file.write(content)
        _sync(file)
        with suppress(FileExistsError):
            os.link(new, path)
            _sync_folder(path.parent)


def move_file(whole: Path, path: Path) -> None:
    """Have a file that is on the disk take the place of `path`, in the same folder."""
    os.replace(whole, path)
    _sync_folder(path.parent)


@contextmanager
def _unfinished(path: Path, mode: int) -> Iterator[tuple[Path, IO[bytes]]]:
    """Open a file beside `path` that is gone after the block, unless it was moved."""
    new = path.with_name(_UNFINISHED.replace("*", token_hex(8)))
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
    try:
        with os.fdopen(os.open(new, flags, mode), "w+b") as file:
            yield new, file
    finally:
        new.unlink(missing_ok=True)


def _sync(file: IO[bytes]) -> None:
    """Have all that was written on the disk."""
    file.flush()
    os.fsync(file.fileno())


def remove_unfinished(folder: Path, own: Iterable[Path]) -> None:
    """Delete what killed writers left in a result folder that nobody writes now.

    own : its folders, in which every file is ours
    """
    found = [*folder.glob(_UNFINISHED), *(folder / name for name in _OLD)]
    for one in own:
        found += [*one.rglob(_UNFINISHED)]
        found += [path for pattern in _OTHERS for path in one.glob(pattern)]
    for path in found:
        path.unlink(missing_ok=True)


class Lines:
    """The writer's end of a file of lines, of which nobody else writes.

    restored : told in a line when the file had to be written again
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
        line = memoryview(f"{text}\n".encode())
        size = len(line)
        try:
            while line:  # a write to a disk that is nearly full may be short
                line = line[os.write(self._fd, line) :]
            os.fsync(self._fd)
        except OSError:
            os.ftruncate(self._fd, self._end)
            raise
        self._end += size

    def restore(self) -> None:
        """Write the file again if it was deleted or replaced since it was opened.

        All that was in it is in the file that we hold open, whatever its name leads to.
        Lines that a file in its place has and ours has not are kept.

        Raises
        ------
        InputError
            When the file has been made shorter or longer by something else.

        """
        held = os.fstat(self._fd)
        if held.st_size != self._end:
            raise InputError(
                f"{self._path} was changed by another program while the run wrote it; "
                "the same command continues with what it holds now"
            )
        with suppress(FileNotFoundError):
            if os.path.samestat(held, self._path.stat()):
                return
        there = _whole_lines(self._path)
        known = set(there)
        mine = os.pread(self._fd, self._end, 0).splitlines(keepends=True)
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
        _sync_folder(self._path.parent)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        os.close(self._fd)


@contextmanager
def full_disk_told(folder: Path) -> Iterator[None]:
    """Turn what a full disk makes Python raise into one line.

    folder : that was written to

    Raises
    ------
    InputError
        When the disk is full, with the file system and how to go on.

    """
    try:
        yield
    except OSError as e:
        if e.errno not in FULL:
            raise
        raise InputError(_full(folder, e.errno)) from e


def refuse_full_disk(folder: Path, failure: str) -> None:
    """Tell whether something failed because the disk is full.

    folder : where it wrote to
    failure : what it said of that

    Raises
    ------
    InputError
        When it was, with the file system and how to go on.

    """
    for code in FULL:
        if os.strerror(code) in failure:
            raise InputError(_full(folder, code))
    with full_disk_told(folder):
        _probe(folder)


def _probe(folder: Path) -> None:
    """Write and delete a small file."""
    path = folder / _UNFINISHED.replace("*", token_hex(8))
    try:
        with suppress(FileNotFoundError), path.open("xb") as file:  # no such folder
            file.write(bytes(_PROBE_BYTES))
    finally:
        path.unlink(missing_ok=True)


def _full(path: Path, code: int) -> str:
    """Say which file system is full, and how to go on."""
    there = next(p for p in (path, *path.absolute().parents) if p.exists())
    root = there.absolute()
    while not os.path.ismount(root):
        root = root.parent
    free = shutil.disk_usage(there).free / _MIB
    return (
        f"{path} cannot be written: {os.strerror(code)} (file system {root}, "
        f"{free:.1f} MiB free); free some space, and the same command continues"
    )


def _sync_folder(folder: Path) -> None:
    """Have the names in a folder on the disk, too."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


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


def _whole_lines(path: Path) -> list[bytes]:
    """Read a file but for a partial last line; no lines where there is no file."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return []
    return content[: content.rfind(b"\n") + 1].splitlines(keepends=True)
