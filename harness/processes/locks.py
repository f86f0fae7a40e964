"""Locks that keep threads of one process from disturbing one another."""

from __future__ import annotations

import os
from contextlib import ContextDecorator
from threading import RLock


class ForkSafeLock(ContextDecorator):
    """A lock that its thread may take again, as a context or around a function.

    In a process that was forked while another thread held it, it is free: that thread
    is not there.
    """

    def __init__(self) -> None:
        self._lock = RLock()
        os.register_at_fork(after_in_child=self._forget_others)

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def _forget_others(self) -> None:
        if self._lock.acquire(blocking=False):  # free, or of the thread that forked
            self._lock.release()
        else:
            self._lock = RLock()
