"""Memory that a tree of processes holds, shared memory included.

Resident memory (VmRSS) counts shared memory only where it is mapped and touched. A file
in /dev/shm holds memory without being mapped, and after its makers are gone: those that
the tree made are counted, each once, and removed with the tree. Libraries that share
arrays between processes (joblib, multiprocessing, MPI) leave such files when they are
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
    """Looks at a tree of processes again and again, and remembers what it has made."""

    def __init__(self) -> None:
        self._before = set(_listed().items())
        self._made: dict[str, int] = {}  # in SHARED, seen in the tree's hands: inodes

    def mib(self, tree: Iterable[int], limit: float) -> float:
        """Give what a tree holds, in MiB.

        Pages that processes share are counted for each of them at first, which is
        cheap. Only where that exceeds `limit` is every page divided by its users.
        """
        tree = list(tree)
        self.notice(tree)
        sizes: dict[int, int] = {}
        for made in self._left():
            for path in (made, *made.rglob("*")):
                with suppress(OSError):
                    at = path.lstat()
                    sizes[at.st_ino] = 512 * at.st_blocks
        files = sum(sizes.values()) / 2**20
        own, mapped = _sum(tree, "status", ("RssAnon", "RssFile"), ("RssShmem",))
        held = own + max(mapped, files)
        if held > limit and len(tree) > 1:
            own, mapped = _sum(
                tree, "smaps_rollup", ("Pss_Anon", "Pss_File"), ("Pss_Shmem",)
            )
            held = own + max(mapped, files) if own else held
        return held

    def notice(self, tree: Iterable[int]) -> None:
        """Take note of the files in SHARED that processes of a tree hold and made."""
        new = dict(set(_listed().items()) - self._before)
        for process in tree if new.keys() - self._made.keys() else ():
            for path in (*_open_files(process), *_mapped_files(process)):
                name = path.removeprefix(f"{SHARED}/").partition("/")[0]
                if path.startswith(f"{SHARED}/") and name in new:
                    self._made[name] = new[name]

    def remove_shared(self) -> None:
        """Remove the files that a tree which has ended left in SHARED."""
        for path in self._left():
            with suppress(OSError):
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink()
        self._made.clear()

    def _left(self) -> list[Path]:
        """List the files of this user that the tree made and that are still there."""
        left = []
        for name, inode in self._made.items():
            with suppress(OSError):
                at = (SHARED / name).lstat()
                if at.st_ino == inode and at.st_uid == os.getuid():
                    left.append(SHARED / name)
        return left


def _open_files(process: int) -> list[str]:
    """List the paths of the files that a process has open."""
    found = []
    with suppress(OSError), os.scandir(f"/proc/{process}/fd") as entries:
        for entry in entries:
            with suppress(OSError):
                found.append(os.readlink(entry.path))
    return found


def _mapped_files(process: int) -> list[str]:
    """List the paths of the files that a process has mapped."""
    try:
        lines = Path(f"/proc/{process}/maps").read_text(errors="replace").splitlines()
    except OSError:
        return []
    return [line[line.index("/") :] for line in lines if "/" in line]


def _listed() -> dict[str, int]:
    """List what lies in SHARED: names with their inode numbers."""
    try:
        with os.scandir(SHARED) as entries:
            return {entry.name: entry.inode() for entry in entries}
    except OSError:
        return {}


def _sum(tree: list[int], file: str, *groups: tuple[str, ...]) -> tuple[float, ...]:
    """Sum groups of lines like "RssAnon: 12 kB" over processes; in MiB."""
    totals = [0.0] * len(groups)
    for process in tree:
        try:
            with open(f"/proc/{process}/{file}") as lines:
                values = dict(line.split(":", 1) for line in lines if ":" in line)
        except OSError:
            continue  # it has ended
        for i, group in enumerate(groups):
            for name in group:
                totals[i] += int(values.get(name, "0").split()[0]) / 1024
    return tuple(totals)
