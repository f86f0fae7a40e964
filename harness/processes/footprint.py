"""Memory of a tree of processes, including shared memory.

Resident memory (VmRSS) includes shared memory only if a process has mapped and touched
it. A file in /dev/shm, however, occupies memory even if no process has mapped it or the
process that created it has ended. Each such file is therefore counted once, and it is
removed when the tree has ended. Libraries that share arrays between processes (joblib,
multiprocessing) would otherwise leave these files behind if their processes are
killed.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

SHARED = Path("/dev/shm")


class Footprint:
    """Meter of the memory of a process tree, including the shared files of the tree."""

    def __init__(self) -> None:
        self._before = set(_listed().items())
        # inode number of each new file in SHARED that the tree had open, by file name
        self._created: dict[str, int] = {}

    def mib(self, tree: Iterable[int], limit: float) -> float:
        """Return the memory of a tree, in MiB.

        Resident sizes are cheap to read, but their sum counts a shared page once per
        process. If the sum over several processes exceeds `limit`, in MiB, the
        proportional set sizes are read instead. Proportional sizes divide the size of a
        shared page among the processes that map it, but the kernel has to walk all page
        tables to compute them.
        """
        tree = list(tree)
        self.notice(tree)
        sizes: dict[int, int] = {}  # bytes by inode, so that hard links count once
        for created in self._remaining():
            for path in (created, *created.rglob("*")):
                with suppress(OSError):
                    status = path.lstat()
                    sizes[status.st_ino] = 512 * status.st_blocks
        files = sum(sizes.values()) / 2**20
        private, mapped = _sum(tree, "status", ("RssAnon", "RssFile"), ("RssShmem",))
        # Take the maximum, since both numbers include the mapped pages of these files.
        total = private + max(mapped, files)
        if total > limit and len(tree) > 1:
            private, mapped = _sum(
                tree, "smaps_rollup", ("Pss_Anon", "Pss_File"), ("Pss_Shmem",)
            )
            total = private + max(mapped, files) if private else total
        return total

    def notice(self, tree: Iterable[int]) -> None:
        """Record new files in SHARED that processes of a tree have opened or mapped.

        Other programs also create files in SHARED, so only open or mapped files are
        attributed to the tree.
        """
        new = dict(set(_listed().items()) - self._before)
        for process in tree if new.keys() - self._created.keys() else ():
            for path in (*_open_files(process), *_mapped_files(process)):
                name = path.removeprefix(f"{SHARED}/").partition("/")[0]
                if path.startswith(f"{SHARED}/") and name in new:
                    self._created[name] = new[name]

    def remove_shared(self) -> None:
        """Remove the files that the ended processes of the tree left in SHARED."""
        for path in self._remaining():
            with suppress(OSError):
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink()
        self._created.clear()

    def _remaining(self) -> list[Path]:
        """List this user's files that the tree created and that still exist."""
        remaining = []
        for name, inode in self._created.items():
            with suppress(OSError):
                status = (SHARED / name).lstat()
                # another program may since have created a file of the same name
                if status.st_ino == inode and status.st_uid == os.getuid():
                    remaining.append(SHARED / name)
        return remaining


def _open_files(process: int) -> list[str]:
    """List the paths of the files that a process has open."""
    paths = []
    with suppress(OSError), os.scandir(f"/proc/{process}/fd") as entries:
        for entry in entries:
            with suppress(OSError):
                paths.append(os.readlink(entry.path))
    return paths


def _mapped_files(process: int) -> list[str]:
    """List the paths of the files that a process has mapped."""
    try:
        lines = Path(f"/proc/{process}/maps").read_text(errors="replace").splitlines()
    except OSError:
        return []
    return [line[line.index("/") :] for line in lines if "/" in line]


def _listed() -> dict[str, int]:
    """Return the inode numbers of the files in SHARED, by name."""
    try:
        with os.scandir(SHARED) as entries:
            return {entry.name: entry.inode() for entry in entries}
    except OSError:
        return {}


def _sum(tree: list[int], file: str, *groups: tuple[str, ...]) -> tuple[float, ...]:
    """Return, for each group of keys, the sum of the values over all processes, in MiB.

    file : file in /proc/PID with lines like "RssAnon: 12 kB"
    """
    totals = [0.0] * len(groups)
    for process in tree:
        try:
            with open(f"/proc/{process}/{file}") as lines:
                values = dict(line.split(":", 1) for line in lines if ":" in line)
        except OSError:
            continue  # the process has ended
        for i, group in enumerate(groups):
            for name in group:
                totals[i] += int(values.get(name, "0").split()[0]) / 1024
    return tuple(totals)
