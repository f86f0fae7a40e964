"""Ranks: the processes of one solve, of which rank 0 leads and the others serve.

All ranks build a problem together; each of them assembles and factorises its own
subdomains. Afterwards, rank 0 alone runs the solver, the certificate and all other
code, on whole vectors. Objects whose methods need all ranks, such as the dual operator,
exist on every rank. Rank 0 calls a method of such an object by `Lead`; the other ranks
receive the name of the method with its arguments (`serve`) and execute the same method,
which ends in a sum or in a gathering on rank 0. Hence every decision is made by rank 0,
and the ranks cannot diverge.

`Comm` is the communicator of one process, and `_MPIComm` that of MPI. Another one, such
as threads, is one more class with these members.
"""

from __future__ import annotations

import os
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from operator import attrgetter
from typing import Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.errors import described

T = TypeVar("T")

PEER_TIMEOUT = 5.0  #: longest time for which a failed rank waits for the other ranks, s
#: Environment variable with the number of a file descriptor. Through this descriptor,
#: ranks report failures to `harness.processes.ranks`, separately from the output of
#: solvers.
RECORD = "MORTARBENCH_RANK_RECORD"
_ORDER = 7  #: MPI tag of the orders of rank 0
_PART = 8  #: MPI tag of the parts of a sum or a vector
#: time after the last order for which a rank waits without sleeping, s; products of one
#: solve follow each other within this time
_SPIN_SECONDS = 0.02
_IDLE_SECONDS = 2e-4  #: time between two tests for an order or an arrival, s
_MESSAGE_BYTES = 500  #: length to which descriptions of failures are truncated


class RankFailedError(Exception):
    """Error for the failure of a rank; the message names the rank and its exception."""


class Comm:
    """Communicator of the ranks of one solve, here of a single process.

    All ranks call each method together. A communicator of several ranks overrides all
    members.
    """

    rank = 0  #: number of this rank, from 0
    size = 1  #: number of ranks

    def sum(self, part: NDArray[Any]) -> NDArray[Any]:
        """Return the sum of the arrays of all ranks on rank 0, undefined elsewhere.

        The arrays are added in the order of ranks, so that equal arrays have the same
        sum in every run.
        """
        return part

    def fill(self, v: NDArray[Any], parts: Sequence[slice]) -> None:
        """Copy the parts of v, one of each rank, from their ranks to v on rank 0."""

    def gather(self, part: T) -> list[T]:
        """Return the values of all ranks on rank 0, an empty list elsewhere."""
        return [part]

    def bcast(self, value: T, root: int = 0) -> T:
        """Return the value of the rank `root`."""
        return value

    def together(self, work: Callable[[], T]) -> T:
        """Call `work` on all ranks; raise on all ranks if it fails on any rank.

        If all ranks raise exceptions with equal messages, each rank re-raises its
        exception.

        Raises
        ------
        RankFailedError
            If `work` failed only on some ranks, or with different messages.

        """
        return work()

    def order(self, order: tuple[Any, ...] | None) -> None:
        """Send an order from rank 0, which alone calls this method, to all others."""

    def next_order(self) -> tuple[Any, ...] | None:
        """Wait for an order of rank 0, and receive it; None ends the service."""

    def abort(self, failure: BaseException) -> NoReturn:
        """Report the failure of this rank, and end the processes of all ranks."""
        raise failure


SERIAL = Comm()


def world() -> Comm:
    """Return the communicator of all ranks that mpiexec has started together."""
    from mpi4py import MPI  # imported here, because only runs on ranks need it

    return _MPIComm(MPI.COMM_WORLD)


class _MPIComm(Comm):
    """Communicator over MPI."""

    def __init__(self, comm: Any) -> None:
        """Duplicate an MPI communicator; all ranks call this together."""
        self._comm = comm
        #: carries the outcomes of `together`, so that they do not meet other messages
        self._outcomes = comm.Dup()
        self.rank, self.size = int(comm.rank), int(comm.size)

    def sum(self, part: NDArray[Any]) -> NDArray[Any]:
        part = np.ascontiguousarray(part)
        if self.rank:
            self._comm.Send(part, dest=0, tag=_PART)
            return part
        # the order of additions in MPI_Reduce may differ from call to call
        total, received = part.copy(), np.empty_like(part)
        for rank in range(1, self.size):
            self._comm.Recv(received, source=rank, tag=_PART)
            total += received
        return total

    def fill(self, v: NDArray[Any], parts: Sequence[slice]) -> None:
        if self.rank:
            self._comm.Send(v[parts[self.rank]], dest=0, tag=_PART)
            return
        for rank in range(1, self.size):  # without pickled copies
            self._comm.Recv(v[parts[rank]], source=rank, tag=_PART)

    def gather(self, part: T) -> list[T]:
        return self._comm.gather(part) or []

    def bcast(self, value: T, root: int = 0) -> T:
        result: T = self._comm.bcast(value, root)
        return result

    def together(self, work: Callable[[], T]) -> T:
        failure: Exception | None = None
        try:
            result = work()
        except Exception as e:
            failure = e
        message = np.zeros(_MESSAGE_BYTES, dtype=np.uint8)
        if failure is not None:
            text = described(failure).encode()[:_MESSAGE_BYTES]
            message[: len(text)] = np.frombuffer(text, dtype=np.uint8)
        messages = np.empty((self.size, _MESSAGE_BYTES), dtype=np.uint8)
        request = self._outcomes.Iallgather(message, messages)
        if failure is None:
            request.Wait()
        deadline = time.monotonic() + PEER_TIMEOUT
        while failure is not None and not request.Test():
            # a rank that does not arrive is probably waiting for this failed rank
            if time.monotonic() > deadline:
                self.abort(failure)
            time.sleep(_IDLE_SECONDS)
        failed = np.flatnonzero(messages.any(axis=1))
        if not failed.size:
            return result
        # messages that the failed ranks have not received must not meet later calls
        self._comm = self._outcomes.Dup()
        if failure is not None and (messages == message).all():
            raise failure
        first = bytes(messages[failed[0]]).rstrip(b"\0").decode(errors="replace")
        raise RankFailedError(self._named(int(failed[0]), first)) from failure

    def order(self, order: tuple[Any, ...] | None) -> None:
        arrays = [x for x in order or () if isinstance(x, np.ndarray)]
        # arrays are sent as they are, which is faster than pickling them
        head = order and tuple(
            _Shape((x.shape, x.dtype.char)) if isinstance(x, np.ndarray) else x
            for x in order
        )
        for rank in range(1, self.size):
            self._comm.send(head, dest=rank, tag=_ORDER)
        for array in arrays:
            self._comm.Bcast(np.ascontiguousarray(array))

    def next_order(self) -> tuple[Any, ...] | None:
        start = time.monotonic()
        while not self._comm.iprobe(source=0, tag=_ORDER):
            # a rank that keeps its CPU busy between solves would disturb others
            spins = time.monotonic() < start + _SPIN_SECONDS
            time.sleep(0 if spins else _IDLE_SECONDS)
        head = self._comm.recv(source=0, tag=_ORDER)
        if head is None:
            return None
        order = [np.empty(*x) if isinstance(x, _Shape) else x for x in head]
        for x, original in zip(order, head, strict=True):
            if isinstance(original, _Shape):
                self._comm.Bcast(x)
        return tuple(order)

    def abort(self, failure: BaseException) -> NoReturn:
        line = self._named(self.rank, described(failure))
        with suppress(OSError, KeyError):  # a single write does not interleave
            os.write(int(os.environ[RECORD]), f"{line}\n".encode())
        with suppress(OSError, ValueError):  # a solver may have closed stderr
            traceback.print_exception(failure)
            sys.stderr.flush()
        self._comm.Abort(1)
        raise SystemExit(1)

    def _named(self, rank: int, message: str) -> str:
        return f"rank {rank} of {self.size}: {message}"[:_MESSAGE_BYTES]


class _Shape(tuple[Any, ...]):
    """Shape and type of an array that follows an order."""


class Lead:
    """Calls of methods of an object that exists on all ranks, from rank 0.

    served : the object on rank 0; None when the other ranks no longer have theirs
    name : name of the attribute, followed by a dot, of the objects with which the other
        ranks run `serve`; empty if they serve the objects themselves
    """

    def __init__(self, comm: Comm, served: Any, name: str = "") -> None:
        self._comm, self.served, self._name = comm, served, name

    def __call__(self, method: str, *arguments: Any) -> Any:
        """Call a method on all ranks; return the result of rank 0.

        An exception on any rank is raised here, see `Comm.together`.

        method : name, with dots for methods of attributes

        Raises
        ------
        RuntimeError
            If the ranks have built another problem in the meantime.

        """
        if self.served is None:
            raise RuntimeError("the ranks keep only the QP that they built last")
        self._comm.order((f"{self._name}{method}", *arguments))
        return self._comm.together(partial(_call, self.served, method, arguments))


def serve(comm: Comm, served: Any) -> None:
    """Execute the methods of `served` that rank 0 calls, until it ends the service."""
    while (order := comm.next_order()) is not None:
        method, *arguments = order
        with suppress(Exception):  # rank 0 raises it as well
            comm.together(partial(_call, served, method, arguments))


def _call(served: Any, method: str, arguments: Sequence[Any]) -> Any:
    return attrgetter(method)(served)(*arguments)


def led(comm: Comm, served: Any, work: Callable[[], T]) -> T:
    """Call `work` on rank 0 while the others serve; return its result on all ranks.

    All ranks call this function together; an exception of `work` is raised on all
    ranks.
    """
    result: Any = None
    if comm.rank:
        serve(comm, served)
    else:
        try:
            result = work()
        except Exception as e:
            result = e
        comm.order(None)
    result = comm.bcast(result)
    if isinstance(result, Exception):
        raise result
    return result  # type: ignore[no-any-return]
