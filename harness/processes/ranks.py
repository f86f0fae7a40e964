"""Workers on several MPI ranks, and the process that starts them.

Runs start `launch` in place of a worker. `launch` calls `mpiexec`, which starts the
worker's command on every rank. The ranks inherit the pipes to the parent. Rank 0 is the
worker of `harness.processes.worker` and communicates with the parent; the other ranks
execute orders that rank 0 sends. Each rank has its own CPU if there are enough CPUs.
The memory limit applies to the sum over all ranks. If one rank ends, all other ranks
are ended.

A solver that supports ranks declares `on_ranks = True`. Its `prepare` is called on
every rank with that rank's share of the QP (`harness.distributed.vectors.Share`), and
the ranks return slices of one solution.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from select import EPOLLIN, PIPE_BUF, epoll
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.linalg import LinearOperator

from mortarbench.harness.distributed.failures import (
    PEER_TIMEOUT,
    RECORD,
    RankFailedError,
    abort,
    in_a_line,
    run_collectively,
)
from mortarbench.harness.distributed.mpi import MISSING, mpiexec
from mortarbench.harness.distributed.vectors import (
    Distributable,
    DistributedQP,
    Emit,
    Ranks,
    Share,
)
from mortarbench.harness.environment.cpus import fastest_first
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.qpfile import load_qp
from mortarbench.harness.operators import Maker, SerialisableOperator
from mortarbench.harness.plugin import Solver
from mortarbench.harness.processes import reaper
from mortarbench.harness.qp import QP, no_rows
from mortarbench.harness.sets.box import Box
from mortarbench.harness.solution import Solution
from mortarbench.harness.verify.measure import memory_mib, reason_to_decline
from mortarbench.harness.verify.verdicts import evaluated_by_ranks

_ORDER = 7  #: MPI tag of the orders that rank 0 sends to the other ranks
_IDLE_SECONDS = 2e-4  #: time between two probes for an order


def launch(ranks: int, command: Sequence[str]) -> int:
    """Run `command` on several MPI ranks, and report on stderr if a rank failed.

    A parent process of each rank records how the rank ended
    (`harness.processes.reaper`). If one rank ends while others are running, the other
    ranks are ended, whatever the exit code. The message therefore names the rank that
    ended first. The output of the ranks is not parsed, since its lines may be
    interleaved.

    command : command line; its last two elements are file descriptors, which the ranks
        inherit

    Returns
    -------
    the exit code: 0 if mpiexec exits with 0, otherwise 1

    """
    start, fds = mpiexec(), tuple(map(int, command[-2:]))
    if start is None:
        print(f"{ranks} ranks: {MISSING}", file=sys.stderr)
        return 1
    # Use all CPUs of this worker again: the supervisor bound this process to one CPU,
    # and its parent, a sub-reaper, to the other CPUs.
    with suppress(OSError):
        usable = os.sched_getaffinity(os.getppid()) | os.sched_getaffinity(0)
        os.sched_setaffinity(0, usable)
    read, write = os.pipe()
    above = [sys.executable, "-I", "-S", reaper.__file__, "rank", str(write)]
    process = subprocess.Popen(
        [start, "-n", str(ranks), *above, *command],
        stdin=subprocess.DEVNULL,
        pass_fds=(*fds, write),
        env=os.environ | {RECORD: str(write)},
    )
    # Close this process's copies of the pipe ends. Otherwise, readers would not receive
    # end of file after the ranks or the parent have closed their copies.
    for fd in (*fds, write):
        os.close(fd)
    first = _RankExits(read, ranks).first(process.pid)
    code = process.poll()
    if code != 0 or first:
        message = first or f"one of {ranks} ranks ended: mpiexec exited with {code}"
        # The parent quotes the last line of the output. The newline ends a possibly
        # unfinished line of a rank.
        print(f"\n{message}", file=sys.stderr)
    return 0 if code == 0 else 1


class _RankExits:
    """Exits of the ranks, in chronological order.

    epoll(7) lists file descriptors in the order in which they became ready, even if the
    caller polls only after several of them are ready. This order identifies the rank
    that ended first, whereas mpiexec names the lowest-numbered rank that has ended. The
    parent process of a rank writes the exit status of the rank. The status is unknown
    if the parent process was killed before it wrote the status.
    """

    def __init__(self, record: int, ranks: int) -> None:
        os.set_blocking(record, False)
        self._record = record
        self._ranks = ranks
        self._unread = b""
        self._rank_of: dict[int, int] = {}  # rank by pidfd of its process
        # first rank that ended, or the message of its failure; None before any exit
        self._first: int | str | None = None
        self._exit_description: dict[int, str] = {}  # descriptions of exits by rank
        self._events = epoll()
        self._events.register(record, EPOLLIN)

    def first(self, mpiexec: int) -> str:
        """Wait until mpiexec has ended; describe the exit of the first rank that ended.

        After the first exit, whatever its code, the wait is limited to `PEER_TIMEOUT`.
        Return "" if mpiexec ended before any rank.

        mpiexec : process ID
        """
        mpi, deadline = os.pidfd_open(mpiexec), np.inf
        self._events.register(mpi, EPOLLIN)
        has_ended = False
        while not has_ended and (left := deadline - time.monotonic()) > 0:
            ready = [fd for fd, _ in self._events.poll(min(left, PEER_TIMEOUT))]
            has_ended = mpi in ready
            for fd in ready:
                if fd in self._rank_of:
                    self._record_first(self._rank_of.pop(fd))
                    os.close(fd)
                else:
                    self._take_records()
                if fd == mpi:  # ranks that end after mpiexec are ended by mpiexec
                    self._record_first("")
            if self._first is not None and deadline == np.inf:
                deadline = time.monotonic() + PEER_TIMEOUT
        if self._first is None or isinstance(self._first, str):
            return self._first or ""
        one = f"rank {self._first}" if self._first >= 0 else "one"
        way = self._exit_description.get(
            self._first, "killed together with its parent process"
        )
        return f"{one} of {self._ranks} ranks ended: {way}"

    def _take_records(self) -> None:
        with suppress(BlockingIOError):
            while chunk := os.read(self._record, 2**16):
                *lines, self._unread = (self._unread + chunk).split(b"\n")
                self._unread = self._unread[:PIPE_BUF]
                for line in lines:
                    with suppress(ValueError, KeyError, TypeError, OSError):
                        self._take(json.loads(line))
            with suppress(FileNotFoundError):  # end of file: all writers have ended
                self._events.unregister(self._record)

    def _take(self, line: Mapping[str, Any]) -> None:
        if "failed" in line:
            self._record_first(line["failed"])
        elif "status" in line:
            self._exit_description[line["rank"]] = _describe_exit(line["status"])
        else:
            for number in (line["process"], line["above"]):
                try:
                    process = os.pidfd_open(number)
                # the process of the rank ended before its record was read
                except ProcessLookupError:
                    self._record_first(line["rank"])
                else:
                    self._rank_of[process] = line["rank"]
                    self._events.register(process, EPOLLIN)

    def _record_first(self, first: int | str) -> None:
        if self._first is None:
            self._first = first


def _describe_exit(status: int) -> str:
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        return f"{signal.strsignal(number)} (signal {number})"
    return f"exit code {os.waitstatus_to_exitcode(status)}"


def this_rank() -> Ranks:
    """Join the other ranks; bind this rank to its own CPU if there are enough CPUs."""
    from mpi4py import MPI  # imported here, because only runs on ranks need it

    cpus = fastest_first(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cpus[MPI.COMM_WORLD.rank % len(cpus)]})
    if RECORD in os.environ:
        os.set_inheritable(int(os.environ[RECORD]), False)
    return Ranks(MPI.COMM_WORLD)


def follow(
    solver: Solver,
    ranks: Ranks,
    operators: Mapping[str, Maker],
    emit: Emit,
    limit: Callable[[float | None], None],
) -> None:
    """Execute the orders of rank 0 on this rank, until rank 0 sends None.

    emit : assembles this rank's share of a case
    limit : sets the memory limit of this process, in MiB; None removes the limit
    """
    run: Callable[[], Solution] | None = None
    share: Share | None = None
    emitted: DistributedQP | None = None
    solution: Solution | None = None
    while (order := _next_order(ranks)) is not None:
        try:
            if "case" in order:
                run = share = emitted = None  # free memory before the next emission
                # all ranks raise the same error, and rank 0 reports it
                with suppress(InputError, RankFailedError):
                    emitted, _ = _emit_on_ranks(emit, order["case"], ranks)
                limit(order["memory_limit"])
            elif "declines" in order and emitted is not None:
                reason_to_decline(solver, emitted.share().qp)
            elif "tol" in order and emitted is not None:
                share = emitted.share()
                run = solver.prepare(share.qp, order["tol"])
                ranks.comm.Barrier()
            elif "qp" in order:
                qp, _ = load_qp(Path(order["qp"]), operators=operators)
                limit(order["memory_limit"])
                share = _share(qp, ranks)
                run = solver.prepare(share.qp, order["tol"])
                ranks.comm.Barrier()
            elif "evaluate" in order and emitted and solution:
                run = share = None  # free the solver's memory before the evaluation
                limit(None)
                evaluated_by_ranks(emitted, solution, ranks)
            elif run is not None and share is not None:
                solution, _ = _solve_on_ranks(run, share, ranks)
        except BaseException as e:
            # If rank 0 also failed, it reports the failure and sends its next order. If
            # no order arrives, rank 0 is waiting for this rank, so all ranks are
            # aborted.
            if _wait_for_order(ranks, PEER_TIMEOUT):
                continue
            abort(ranks, e)


def _next_order(ranks: Ranks) -> dict[str, Any] | None:
    _wait_for_order(ranks, np.inf)
    order: dict[str, Any] | None = ranks.comm.recv(source=0, tag=_ORDER)
    return order


def _wait_for_order(ranks: Ranks, seconds: float) -> bool:
    """Wait for an order; return False if none arrives within `seconds`.

    The loop sleeps between probes, because a blocking receive would keep the CPU busy.
    """
    deadline = time.monotonic() + seconds
    while not ranks.comm.iprobe(source=0, tag=_ORDER):
        if time.monotonic() > deadline:
            return False
        time.sleep(_IDLE_SECONDS)
    return True


class ParallelSolver:
    """Solver on rank 0 that sends orders to the other ranks.

    The ranks jointly solve one QP, and each rank has a share of the QP.
    """

    def __init__(self, solver: Solver, ranks: Ranks, emit: Emit) -> None:
        # messages of failures use `__wrapped__` to find the file of the wrapped solver
        self._solver = self.__wrapped__ = solver
        self._ranks = ranks
        self._emit = emit
        self._emitted: DistributedQP | None = None
        self._emission_error: Exception | None = None
        self._path = Path()
        self._memory_limit: float | None = None
        self._local_solution: Solution | None = None

    def emit(
        self, case: Mapping[str, Any], memory_limit: float | None
    ) -> tuple[QP, dict[str, Any]]:
        """Order all ranks to emit their shares of the next QP.

        Returns
        -------
        a placeholder QP of the same sizes, and the entries of the event "emitted": the
        `sizes` and the `digest` of the QP, and the time of the slowest rank, in s. If
        the emission fails, the placeholder has size zero, the entries are empty, and
        `declines` or `prepare` reports the failure.

        """
        self._order({"case": dict(case), "memory_limit": memory_limit})
        self._emitted = self._emission_error = self._local_solution = None
        try:
            self._emitted, emission = _emit_on_ranks(self._emit, case, self._ranks)
        except (InputError, RankFailedError) as e:
            self._emission_error = e
            return qp_of_sizes(0, 0), {"sizes": {}, "digest": "", "build_seconds": None}
        sizes = self._emitted.variables, self._emitted.equality_rows
        return qp_of_sizes(*sizes), emission

    def evaluate(self) -> dict[str, Any] | None:
        """Evaluate the last answer on all ranks; return None if its QP was not emitted.

        Returns
        -------
        the result of `harness.verify.verdicts.evaluated_by_ranks`

        """
        if self._emitted is None or self._local_solution is None:
            return None
        self._order({"evaluate": True})
        return evaluated_by_ranks(self._emitted, self._local_solution, self._ranks)

    def use_file(self, path: Path, memory_limit: float | None) -> None:
        """Set the file from which all ranks read the next QP, instead of emitting it.

        memory_limit : limit for each rank, in MiB; None for no limit
        """
        self._emitted = self._emission_error = self._local_solution = None
        self._path, self._memory_limit = path, memory_limit

    def end(self) -> None:
        """Order the other ranks to end."""
        self._order(None)

    @property
    def accepts(self) -> tuple[type, ...]:
        """Classes of convex sets that the solver accepts."""
        return getattr(self._solver, "accepts", (Box,))

    def declines(self, qp: QP) -> str | None:
        """Return the reason why the ranks cannot solve the QP, or None if they can."""
        if not getattr(self._solver, "on_ranks", False):
            return "runs in one process only; expected one rank"
        # if the emission failed with another error, `prepare` raises it
        if self._emission_error is not None:
            is_input_error = isinstance(self._emission_error, InputError)
            return str(self._emission_error) if is_input_error else None
        if self._emitted is not None:
            self._order({"declines": True})
            return reason_to_decline(self._solver, self._emitted.share().qp)
        product = qp.P.build() if isinstance(qp.P, SerialisableOperator) else None
        if not isinstance(product, Distributable):
            return "P cannot be distributed over ranks; expected a case in subdomains"
        if product.parts < self._ranks.size:
            return (
                f"{self._ranks.size} ranks for {product.parts} subdomains; expected at "
                "most one rank per subdomain"
            )
        return self._solver.declines(qp)

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        """Prepare on all ranks; return when the slowest rank is ready."""
        if self._emission_error is not None:
            raise self._emission_error
        if self._emitted is not None:
            self._order({"tol": tol})
            share = self._emitted.share()
        else:
            order = {
                "qp": str(self._path),
                "tol": tol,
                "memory_limit": self._memory_limit,
            }
            self._order(order)
            share = _share(qp, self._ranks)
        run = self._solver.prepare(share.qp, tol)
        self._ranks.comm.Barrier()

        def solve() -> Solution:
            self._order({})
            self._local_solution, solution = _solve_on_ranks(run, share, self._ranks)
            assert solution is not None  # on rank 0
            return solution

        return solve

    def _order(self, order: dict[str, Any] | None) -> None:
        for rank in range(1, self._ranks.size):
            self._ranks.comm.send(order, dest=rank, tag=_ORDER)


def _emit_on_ranks(
    emit: Emit, case: Mapping[str, Any], ranks: Ranks
) -> tuple[DistributedQP, dict[str, Any]]:
    """Emit a case on all ranks; return the local part and the entries of the event.

    Any error is raised on all ranks.

    Raises
    ------
    InputError
        If the family raises an InputError on every rank.
    RankFailedError
        If the emission fails in any other way on at least one rank.

    """
    start = time.perf_counter()
    try:
        emitted = run_collectively(ranks, lambda: emit(case, ranks))
        # The call above is collective: it returns when the slowest rank is done.
        seconds = time.perf_counter() - start
        digest = run_collectively(ranks, emitted.digest)
        entries = {"sizes": emitted.sizes, "digest": digest, "build_seconds": seconds}
        return emitted, entries
    except InputError:
        raise
    except Exception as e:
        why = str(e) if isinstance(e, RankFailedError) else in_a_line(e)
        raise RankFailedError(f"emission: {why}") from e


def qp_of_sizes(variables: int, equality_rows: int) -> QP:
    """Return a placeholder of given sizes for a QP that no single process stores.

    Vectors with a component for each variable are broadcast scalars, which occupy
    almost no memory.
    """
    n, m = variables, equality_rows
    zeros = np.broadcast_to(0.0, n)
    return QP(
        P=LinearOperator((n, n), matvec=lambda x: 0 * x, dtype=float),
        q=zeros,
        lb=zeros,
        ub=zeros,
        G=no_rows(n),
        h=np.zeros(0),
        A=csr_array((m, n)),
        b=np.zeros(m),
    )


def _share(qp: QP, ranks: Ranks) -> Share:
    product = qp.P.build()
    assert isinstance(product, Distributable)
    return product.share(qp, ranks)


def _solve_on_ranks(
    run: Callable[[], Solution], share: Share, ranks: Ranks
) -> tuple[Solution, Solution | None]:
    """Solve the local share of a QP.

    Returns
    -------
    the local slice of the solution, and on rank 0 also the entire solution with the
    memory of the ranks; None on other ranks

    """
    s = run()
    solution = share.whole(s)
    peaks = ranks.comm.gather(memory_mib("VmHWM") or 0.0)
    if solution is None or peaks is None:
        return s, None
    reported = {
        **solution.reported,
        "ranks": ranks.size,
        "rank_peak_mib_largest": max(peaks),
        "rank_peak_mib_mean": sum(peaks) / ranks.size,
    }
    return s, replace(solution, reported=reported)
