"""Locks for processes, and for the threads of a process that may fork."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import ContextDecorator, contextmanager
from pathlib import Path
from threading import RLock


class ForkSafeLock(ContextDecorator):
    """Reentrant lock, used as a context manager or as a decorator.

    If another thread holds the lock at the time of a fork, the lock is free in the
    child, where that thread does not exist and could never release it.
    """

    def __init__(self) -> None:
        self._lock = RLock()
        os.register_at_fork(after_in_child=self._release_in_child)

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def _release_in_child(self) -> None:
        # the lock was free, or held by the forking thread
        if self._lock.acquire(blocking=False):
            self._lock.release()
        else:
            self._lock = RLock()


@contextmanager
def file_lock(path: Path, *, flags: int = 0, waits: bool = True) -> Iterator[None]:
    """Hold an exclusive lock on a file or folder, which a process loses when it ends.

    flags : further flags of open(2)
    waits : False to raise BlockingIOError if another process holds the lock

    Raises
    ------
    OSError
        If the file cannot be opened, for instance because it is a symbolic link.

    """
    fd = os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | (0 if waits else fcntl.LOCK_NB))
        yield
    finally:
        os.close(fd)  # also releases the lock
