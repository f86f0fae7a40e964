"""Ranks as threads of one process: `harness.distributed.comm` without MPI.

`ThreadComm` passes messages in memory, so that a test on three ranks takes
milliseconds. It replaces mpi4py's communicator only; all methods of the communicator of
the package are executed. Values are pickled, as in mpi4py. A rank that waits for
another one fails after `LONGEST` seconds, or as soon as another rank has failed.
"""

from __future__ import annotations

import pickle
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from queue import SimpleQueue
from threading import Barrier, BrokenBarrierError
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np
import pytest

from mortarbench.harness.distributed.comm import Comm, Team, _MPIComm
from mortarbench.problems.feti.operators import DualOperator
from tests.support.waiting import LONGEST

T = TypeVar("T")


class ThreadComm:
    """The part of mpi4py's communicators that `harness.distributed.comm` uses."""

    def __init__(self, rank: int, shared: SimpleNamespace) -> None:
        self.rank, self.size, self._shared = rank, shared.barrier.parties, shared
        self._rounds = self._copies = 0

    def _exchange(self, value: Any) -> list[Any]:
        self._shared.slots[self.rank] = pickle.dumps(value)
        self._shared.barrier.wait(LONGEST)
        found = list(map(pickle.loads, self._shared.slots))
        self._shared.barrier.wait(LONGEST)
        return found

    def Dup(self) -> ThreadComm:
        self._copies += 1
        copies, all_of_them = self._shared.copies, self._shared.every
        new = copies.setdefault(self._copies, _shared(self.size, all_of_them))
        return ThreadComm(self.rank, new)

    def Send(self, part: np.ndarray, dest: int, tag: int) -> None:
        self._shared.parts[self.rank, dest].put(part.copy())

    def Recv(self, part: np.ndarray, source: int, tag: int) -> None:
        parts = self._shared.parts[source, self.rank]
        while parts.empty():
            if self._shared.barrier.broken:
                raise BrokenBarrierError
            time.sleep(1e-4)
        part[...] = parts.get()

    def gather(self, value: Any) -> list[Any] | None:
        found = self._exchange(value)
        return None if self.rank else found

    def Bcast(self, array: np.ndarray) -> None:
        array[...] = self._exchange(None if self.rank else array)[0]

    def send(self, value: Any, dest: int, tag: int) -> None:
        self._shared.inboxes[dest].put(pickle.dumps(value))

    def iprobe(self, source: int, tag: int) -> bool:
        if self._shared.barrier.broken:
            raise BrokenBarrierError
        return not self._shared.inboxes[self.rank].empty()

    def recv(self, source: int, tag: int) -> Any:
        return pickle.loads(self._shared.inboxes[self.rank].get(timeout=LONGEST))

    def Iallgather(self, part: np.ndarray, every: np.ndarray) -> Any:
        here = self._shared.gathered.setdefault(self._rounds, {})
        self._rounds += 1
        here[self.rank] = part.copy()

        def test() -> bool:
            if len(here) == self.size:
                every[...] = [here[rank] for rank in range(self.size)]
            elif self._shared.barrier.broken:
                raise BrokenBarrierError
            return len(here) == self.size

        def wait() -> None:
            while not test():
                time.sleep(1e-4)

        return SimpleNamespace(Test=test, Wait=wait)

    def Abort(self, code: int) -> None:
        for shared in self._shared.every:
            shared.barrier.abort()


def _shared(size: int, every: list[SimpleNamespace]) -> SimpleNamespace:
    """Return data that ranks share, and add them to the list of all such data."""
    shared = SimpleNamespace(
        barrier=Barrier(size), slots=[b""] * size, gathered={}, copies={}, every=every,
        inboxes=[SimpleQueue() for _ in range(size)],
        parts=defaultdict(SimpleQueue),
    )  # fmt: skip
    every.append(shared)
    return shared


def on_ranks(size: int, work: Callable[[Comm], T]) -> list[T | BaseException]:
    """Return the results of `work` on all ranks, in order, or their exceptions."""
    shared = _shared(size, [])

    def one(rank: int) -> T | BaseException:
        comm = ThreadComm(rank, shared)
        try:
            return work(_MPIComm(comm))
        except BaseException as e:
            comm.Abort(1)  # otherwise the other ranks would wait
            return e

    with ThreadPoolExecutor(size) as pool:
        return list(pool.map(one, range(size)))


def results_of(size: int, work: Callable[[Comm], T]) -> list[T]:
    """Return the results of `work` on all ranks, in order; raise the first failure."""
    found = on_ranks(size, work)
    failed = [e for e in found if isinstance(e, BaseException)]
    for e in sorted(failed, key=lambda e: isinstance(e, BrokenBarrierError)):
        raise e
    return found


def on_rank_0(size: int, work: Callable[[Team], T]) -> T:
    """Return the result of `work` on rank 0, while the other ranks serve."""

    def one(comm: Comm) -> T | None:
        team = Team(comm)
        if comm.rank:
            team.serve()
            return None
        result = work(team)
        team.end()
        return result

    result = results_of(size, one)[0]
    assert result is not None
    return result


def unlock(patch: pytest.MonkeyPatch) -> None:
    """Allow ranks to exchange messages while they compute a cached property.

    Before Python 3.12, a lock allows only one thread at a time to compute the property,
    for all instances.
    """
    for owner, name in (
        (DualOperator, "linear_map"),
        (DualOperator, "_blocks"),
        (DualOperator, "_diagonal"),
    ):
        patch.setattr(vars(owner)[name], "lock", nullcontext(), raising=False)
