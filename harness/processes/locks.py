"""Locks for the threads of a process that may fork."""

from __future__ import annotations

import os
from contextlib import ContextDecorator
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
