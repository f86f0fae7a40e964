"""Ranks as threads of one process, for tests of communication.

Messages are passed in memory, so that a test on three ranks takes milliseconds. A rank
that waits for a message that is never sent fails after `PATIENCE` seconds.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from queue import Queue
from threading import Barrier, BrokenBarrierError
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np

from mortarbench.harness.distributed.vectors import Ranks

PATIENCE = 60.0  #: s; a busy machine may stop a thread for seconds
R = TypeVar("R")


class Comm:
    """The part of mpi4py's communicators that `harness.distributed` uses."""

    def __init__(self, rank: int, size: int, barrier: Barrier, slots: list[Any]):
        self.rank, self.size = rank, size
        self._barrier, self._slots = barrier, slots
        self._inbox: list[Any] = [Queue() for _ in range(size)]  # by source
        self.others: list[Comm] = []

    def allgather(self, value: Any) -> list[Any]:
        self._slots[self.rank] = value
        self._barrier.wait(PATIENCE)
        found = list(self._slots)
        self._barrier.wait(PATIENCE)
        return found

    def gather(self, value: Any) -> list[Any] | None:
        found = self.allgather(value)
        return found if self.rank == 0 else None

    def Allgather(self, part: np.ndarray, parts: np.ndarray) -> None:
        parts[...] = self.allgather(part.copy())

    def Allreduce(self, part: np.ndarray, found: np.ndarray) -> None:
        found[...] = sum(self.allgather(part.copy()))

    def Isend(self, array: np.ndarray, dest: int) -> Any:
        assert array.flags.c_contiguous
        self.others[dest]._inbox[self.rank].put(array.copy())
        return SimpleNamespace(Wait=lambda: None)

    def Irecv(self, array: np.ndarray, source: int) -> Any:
        assert array.flags.c_contiguous

        def wait() -> None:
            sent = self._inbox[source].get(timeout=PATIENCE)
            if sent is None:
                raise BrokenBarrierError
            assert sent.shape == array.shape
            array[...] = sent

        return SimpleNamespace(Wait=wait)


def without_lock(monkeypatch: Any, owner: type, name: str) -> None:
    """Allow ranks to exchange messages while they compute a cached property.

    Before Python 3.12, a lock allows only one thread at a time to compute the property,
    for all instances.
    """
    monkeypatch.setattr(vars(owner)[name], "lock", nullcontext(), raising=False)


def on_threads(size: int, work: Callable[[Ranks], R]) -> list[R]:
    """Return the results of `work` on all ranks, in order."""
    barrier, slots = Barrier(size), [None] * size
    comms = [Comm(rank, size, barrier, slots) for rank in range(size)]
    for comm in comms:
        comm.others = comms

    def one(comm: Comm) -> R:
        try:
            return work(Ranks(comm))  # type: ignore[arg-type]
        except BaseException:
            barrier.abort()  # otherwise the other ranks would wait
            for other in comms:
                other._inbox[comm.rank].put(None)
            raise

    with ThreadPoolExecutor(size) as pool:
        running = [pool.submit(one, comm) for comm in comms]
    failed = [e for r in running if (e := r.exception()) is not None]
    for e in failed:
        if not isinstance(e, BrokenBarrierError):
            raise e
    return [r.result() for r in running]
