"""Files that outlive a crash: whole or not there; and full disks.

A process may die, and a disk may be full, at any instant. A file that is replaced holds
either its old content or all of its new one. Files of lines: `harness.files.lines`.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from secrets import token_hex
from typing import IO

from mortarbench.harness.errors import InputError

_UNFINISHED = ".mortarbench-*.tmp"  #: what files are called until they are whole
_OTHERS = ("*.tmp", "*.new", ".*.new")  #: of older versions, and of a case being built
_OLD = ("suite.tmp", "environment.tmp")

#: of an OSError: the disk, or our share of it, takes no more
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_PROBE_BYTES = 2**16
_MIB = 2**20


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Open a new file that takes the place of `path` at the end of the block.

    It is on the disk by then. Whatever happens, `path` leads to what was there before
    or to all that was written; who has opened or mapped the old file keeps that.
    """
    new = path.with_name(_UNFINISHED.replace("*", token_hex(8)))
    try:
        with new.open("x+b") as file:
            yield file
            _sync(file)
            move_file(new, path)
    finally:
        new.unlink(missing_ok=True)


def replace_file(path: Path, content: bytes | memoryview) -> None:
    """Write a file as `replacing` does; its folder is made if need be."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        file.write(content)


def move_file(whole: Path, path: Path) -> None:
    """Have a file that is on the disk take the place of `path`, in the same folder."""
    os.replace(whole, path)
    sync_folder(path.parent)


def _sync(file: IO[bytes]) -> None:
    """Flush and fsync."""
    file.flush()
    os.fsync(file.fileno())


def remove_unfinished(
    folder: Path, own: Iterable[Path], shared: Iterable[Path] = ()
) -> None:
    """Delete what killed writers left in a result folder that nobody writes now.

    own : its folders, in which every file is ours
    shared : its folders that may hold files of the user, too
    """
    found = [*folder.glob(_UNFINISHED), *(folder / name for name in _OLD)]
    found += [path for one in shared for path in one.glob(_UNFINISHED)]
    for one in own:
        found += [*one.rglob(_UNFINISHED)]
        found += [path for pattern in _OTHERS for path in one.glob(pattern)]
    for path in found:
        path.unlink(missing_ok=True)


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


def sync_folder(folder: Path) -> None:
    """Flush the names in a folder to the disk."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
