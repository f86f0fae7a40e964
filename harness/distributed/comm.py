"""Ranks: the processes of one solve, of which rank 0 leads and the others serve.

Rank 0 builds a problem and runs the solver, the certificate and all other code, on
whole vectors. Objects whose work is divided, such as the subdomains and the dual
operator, have a part on every rank. Rank 0 places the parts and calls their methods
(`Team`); the other ranks receive each order (`Team.serve`) and execute the same method
of their parts, whose results are added or collected on rank 0. Hence every decision is
made by rank 0, and the ranks cannot diverge.

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
from itertools import count
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

    def scatter(self, parts: Sequence[T] | None) -> T:
        """Return the part of this rank; rank 0 sends one part to each rank."""
        assert parts is not None
        return parts[0]

    def split(self, v: NDArray[Any] | None, ends: Sequence[int], kind: str) -> Any:
        """Return the part of this rank of a vector of rank 0.

        v : vector on rank 0, None elsewhere
        ends : the part of rank r begins at ``ends[r]`` and ends before ``ends[r + 1]``
        kind : character of the data type of v
        """
        return v

    def join(self, part: NDArray[Any], ends: Sequence[int]) -> NDArray[Any]:
        """Return the vector with the parts of all ranks on rank 0; see `split`."""
        return part

    def gather(self, part: T) -> list[T]:
        """Return the values of all ranks on rank 0, an empty list elsewhere."""
        return [part]

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

    def scatter(self, parts: Sequence[T] | None) -> T:
        if parts is None:
            part: T = self._comm.recv(source=0, tag=_PART)
            return part
        for rank in range(1, self.size):  # one after the other, to limit the memory
            self._comm.send(parts[rank], dest=rank, tag=_PART)
        return parts[0]

    def split(self, v: NDArray[Any] | None, ends: Sequence[int], kind: str) -> Any:
        if v is None:
            part = np.empty(ends[self.rank + 1] - ends[self.rank], dtype=kind)
            self._comm.Recv(part, source=0, tag=_PART)
            return part
        for rank in range(1, self.size):  # without pickled copies
            part = np.ascontiguousarray(v[ends[rank] : ends[rank + 1]])
            self._comm.Send(part, dest=rank, tag=_PART)
        return v[: ends[1]]

    def join(self, part: NDArray[Any], ends: Sequence[int]) -> NDArray[Any]:
        if self.rank:
            self._comm.Send(np.ascontiguousarray(part), dest=0, tag=_PART)
            return part
        v = np.empty(ends[-1], dtype=part.dtype)
        v[: ends[1]] = part
        for rank in range(1, self.size):
            self._comm.Recv(v[ends[rank] : ends[rank + 1]], source=rank, tag=_PART)
        return v

    def gather(self, part: T) -> list[T]:
        return self._comm.gather(part) or []

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


class Team:
    """Objects with a part on every rank, which rank 0 places and uses.

    service : object of this rank, which is the part with the number 0
    """

    def __init__(self, comm: Comm = SERIAL, service: Any = None) -> None:
        self.comm, self._parts = comm, {0: service}
        self._numbers, self.unused = count(1), list[int]()

    def place(
        self, build: Callable[..., Any], parts: Sequence[Any], *others: Placed
    ) -> Placed:
        """Call `build` on every rank, and keep its result there.

        An exception on any rank is raised here, see `Comm.together`.

        Parameters
        ----------
        build : function of a module; its arguments are a value of `parts` and the part
            of each of `others` on the same rank
        parts : value for each rank, which must be picklable except for that of rank 0

        """
        placed = Placed(self, next(self._numbers))
        numbers = tuple(other.number for other in others)
        self.order("_place", build, placed.number, *numbers, data=parts)
        return placed

    def order(self, step: str, *arguments: Any, data: Any = None) -> Any:
        """Execute a step on all ranks; return the result of rank 0.

        step : name of a method of this class
        data : first argument of the method on rank 0; None on all other ranks
        """
        unused, self.unused = tuple(self.unused), []
        self.comm.order((step, unused, *arguments))
        return self._execute(step, unused, *arguments, data=data)

    def serve(self) -> None:
        """Execute the steps that rank 0 orders, until it ends the service."""
        while (order := self.comm.next_order()) is not None:
            with suppress(Exception):  # rank 0 raises it as well
                self._execute(*order)

    def end(self) -> None:
        """End the service of the other ranks."""
        self.comm.order(None)

    def _execute(
        self, step: str, unused: Sequence[int], *arguments: Any, data: Any = None
    ) -> Any:
        for number in unused:
            self._parts.pop(number, None)
        return getattr(self, step)(data, *arguments)

    def _place(
        self, parts: Any, build: Callable[..., Any], number: int, *others: int
    ) -> None:
        part = self.comm.scatter(parts)
        self._parts[number] = self.comm.together(
            lambda: build(part, *(self._parts[other] for other in others))
        )

    def _call(self, _: None, *call: Any) -> list[Any]:
        return self.comm.gather(self._result(*call))

    def _total(self, _: None, *call: Any) -> Any:
        return self.comm.sum(self._result(*call))

    def _apply(self, v: Any, ends: Sequence[int], kind: str, *call: Any) -> Any:
        part = self.comm.split(v, ends, kind)
        return self.comm.join(self._result(*call, part), ends)

    def _result(self, number: int, method: str, *arguments: Any) -> Any:
        """Return the result of a method on this rank, if no rank has failed.

        No rank waits for the result of a rank that has failed.
        """
        return self.comm.together(
            lambda: getattr(self._parts[number], method)(*arguments)
        )


class Placed:
    """An object with a part on every rank; the parts are freed with this object."""

    def __init__(self, team: Team, number: int) -> None:
        self._team, self.number = team, number

    def __call__(self, method: str, *arguments: Any) -> list[Any]:
        """Call a method of every part; return the results of all ranks."""
        results: list[Any] = self._team.order("_call", self.number, method, *arguments)
        return results

    def total(self, method: str, *arguments: Any) -> NDArray[Any]:
        """Return the sum of the arrays that a method of every part returns."""
        total: NDArray[Any] = self._team.order(
            "_total", self.number, method, *arguments
        )
        return total

    def apply(self, method: str, v: NDArray[Any], ends: Sequence[int]) -> NDArray[Any]:
        """Return a vector of which every part computes a section from that of v.

        ends : section r of a vector begins at ``ends[r]`` and ends at ``ends[r + 1]``
        """
        call = tuple(ends), v.dtype.char, self.number, method
        result: NDArray[Any] = self._team.order("_apply", *call, data=v)
        return result

    def __del__(self) -> None:
        """Free the parts with the next order."""
        self._team.unused.append(self.number)
