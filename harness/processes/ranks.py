"""A worker on several ranks of MPI, and the process that starts them.

`launch` is what runs start in place of a worker: it has `mpiexec` start the worker as
so many processes, which inherit the pipes to the parent. Rank 0 is the worker of
`harness.processes.worker`, and speaks with the parent; the others follow it. Each rank
has a CPU to itself while there are enough. What all of them hold together counts for
the limit of memory, and all of them end with any of them.

A solver that can run so says `on_ranks = True`: its `prepare` is called on every rank
with that rank's share of the QP (`harness.distributed.vectors.Share`), and every rank
comes to the same solution, in slices.

Copies are what ranks are compared with: each rank solves all of the QP by itself, at
the same time as the others, with whom it shares nothing but the machine. The slowest
tells the time.
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
from typing import Any, NamedTuple

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
from mortarbench.harness.distributed.network import network
from mortarbench.harness.distributed.vectors import (
    Distributable,
    DistributedQP,
    Emit,
    Ranks,
    Share,
)
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.qpfile import load_qp
from mortarbench.harness.operators import Maker, SerialisableOperator
from mortarbench.harness.plugin import Solver
from mortarbench.harness.processes import reaper
from mortarbench.harness.qp import QP, no_rows
from mortarbench.harness.sets.box import Box
from mortarbench.harness.solution import Solution
from mortarbench.harness.verify.measure import memory_mib
from mortarbench.harness.verify.verdicts import evaluated_by_ranks

_ORDER = 7  #: tag of what rank 0 tells the others to do
_IDLE_SECONDS = 2e-4  #: between two looks for an order


def launch(ranks: int, command: Sequence[str]) -> int:
    """Start `command` on so many ranks, wait until they have ended, and say how.

    Above each rank is a process that records its end (`harness.processes.reaper`). The
    rank that ended first is named: others end because it did. One that ends while the
    others go on ends them, too, whatever its exit code. What ranks print is not read.

    The last two words of the command are file descriptors, which the ranks inherit.
    """
    start, fds = mpiexec(), tuple(map(int, command[-2:]))
    if start is None:
        print(f"{ranks} ranks: {MISSING}", file=sys.stderr)
        return 1
    # ours is one CPU, that of a worker; our parent has the rest
    with suppress(OSError):
        usable = os.sched_getaffinity(os.getppid()) | os.sched_getaffinity(0)
        os.sched_setaffinity(0, usable)
    read, write = os.pipe()
    above = [sys.executable, "-I", "-S", reaper.__file__, "rank", str(write)]
    process = subprocess.Popen(
        [start, "-n", str(ranks), *above, *command], stdin=subprocess.DEVNULL,
        pass_fds=(*fds, write), env=os.environ | {RECORD: str(write)},
    )  # fmt: skip
    for fd in (*fds, write):
        os.close(fd)
    first = _Ends(read, ranks).first(process.pid)
    code = process.poll()
    if code != 0 or first:
        said = first or f"one of {ranks} ranks ended: mpiexec says {code}"
        print(f"\n{said}", file=sys.stderr)  # after a line that has no end
    return 0 if code == 0 else 1


class _Ends:
    """The ends of ranks, in the order of time.

    The kernel lists what becomes ready in that order, see epoll(7), however late we
    look. The exit status of a rank comes from the process above it, and is not known
    where that one was killed first.
    """

    def __init__(self, record: int, ranks: int) -> None:
        os.set_blocking(record, False)
        self._record = record
        self._ranks = ranks
        self._unread = b""
        self._rank_of: dict[int, int] = {}  # by a file descriptor of its process
        self._first: int | str | None = None  # a rank, or what one said of its failure
        self._way: dict[int, str] = {}  # how ranks ended
        self._events = epoll()
        self._events.register(record, EPOLLIN)

    def first(self, mpiexec: int) -> str:
        """Wait until mpiexec has ended, and describe the end of the first rank.

        The others have `PEER_TIMEOUT` to end after it, whatever its exit code. Empty
        where mpiexec was the first to end.
        """
        mpi, deadline = os.pidfd_open(mpiexec), np.inf
        self._events.register(mpi, EPOLLIN)
        has_ended = False
        while not has_ended and (left := deadline - time.monotonic()) > 0:
            ready = [fd for fd, _ in self._events.poll(min(left, PEER_TIMEOUT))]
            has_ended = mpi in ready
            for fd in ready:
                if fd in self._rank_of:
                    self._note(self._rank_of.pop(fd))
                    os.close(fd)
                else:
                    self._take_records()
                if fd == mpi:  # ranks that end now, end because it has
                    self._note("")
            if self._first is not None and deadline == np.inf:
                deadline = time.monotonic() + PEER_TIMEOUT
        if self._first is None or isinstance(self._first, str):
            return self._first or ""
        one = f"rank {self._first}" if self._first >= 0 else "one"
        way = self._way.get(self._first, "killed, as was the process above it")
        return f"{one} of {self._ranks} ranks ended: {way}"

    def _take_records(self) -> None:
        with suppress(BlockingIOError):
            while chunk := os.read(self._record, 2**16):
                *lines, self._unread = (self._unread + chunk).split(b"\n")
                self._unread = self._unread[:PIPE_BUF]
                for line in lines:
                    with suppress(ValueError, KeyError, TypeError, OSError):
                        self._take(json.loads(line))
            with suppress(FileNotFoundError):  # nobody can write any longer
                self._events.unregister(self._record)

    def _take(self, line: Mapping[str, Any]) -> None:
        if "failed" in line:
            self._note(line["failed"])
        elif "status" in line:
            self._way[line["rank"]] = _way_to_end(line["status"])
        else:
            for number in (line["process"], line["above"]):
                try:
                    process = os.pidfd_open(number)
                except ProcessLookupError:  # it has ended already
                    self._note(line["rank"])
                else:
                    self._rank_of[process] = line["rank"]
                    self._events.register(process, EPOLLIN)

    def _note(self, first: int | str) -> None:
        if self._first is None:
            self._first = first


def _way_to_end(status: int) -> str:
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        return f"{signal.strsignal(number)} (signal {number})"
    return f"exit code {os.waitstatus_to_exitcode(status)}"


def this_rank() -> Ranks:
    """Join the other ranks, on a CPU of our own if there is one for each.

    How fast they talk to one another is measured at once, before anything is timed.
    """
    from mpi4py import MPI  # late: whoever starts no ranks needs none

    cpus = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cpus[MPI.COMM_WORLD.rank % len(cpus)]})
    if RECORD in os.environ:
        os.set_inheritable(int(os.environ[RECORD]), False)
    return Ranks(MPI.COMM_WORLD, network=network(MPI.COMM_WORLD))


def follow(
    solver: Solver,
    ranks: Ranks,
    operators: Mapping[str, Maker],
    emit: Emit,
    limit: Callable[[float | None], None],
) -> None:
    """Do on this rank what rank 0 orders, until it orders nothing more.

    emit : makes this rank's share of a case
    limit : limits the memory of this process, in MiB
    """
    run: Callable[[], Solution] | None = None
    share: Share | None = None
    emitted: DistributedQP | None = None
    solution: Solution | None = None
    while (order := _next_order(ranks)) is not None:
        try:
            if "case" in order:
                run = share = emitted = None  # before another one is made
                # what all raise, or agree upon, is told by rank 0
                with suppress(InputError, RankFailedError):
                    emitted, _ = _emitted(emit, order["case"], ranks)
                limit(order["memory_limit"])
            elif "declines" in order and emitted is not None:
                solver.declines(emitted.share().qp)
            elif "tol" in order and emitted is not None:
                share = emitted.share()
                run = solver.prepare(share.qp, order["tol"])
                ranks.comm.Barrier()
            elif "qp" in order:
                qp, _ = load_qp(Path(order["qp"]), operators=operators)
                limit(order["memory_limit"])
                share = _share(qp, ranks, copies=order["copies"])
                run = solver.prepare(share.qp, order["tol"])
                ranks.comm.Barrier()
            elif "evaluate" in order and emitted and solution:
                run = share = None  # what the solver has made makes room
                limit(None)
                evaluated_by_ranks(emitted, solution, ranks)
            elif run is not None and share is not None:
                solution, _ = _solved(run, share, ranks)
        except BaseException as e:
            if _ordered(ranks, PEER_TIMEOUT):
                continue  # rank 0 has failed alike, and says so
            abort(ranks, e)


def _next_order(ranks: Ranks) -> dict[str, Any] | None:
    _ordered(ranks, np.inf)
    order: dict[str, Any] | None = ranks.comm.recv(source=0, tag=_ORDER)
    return order


def _ordered(ranks: Ranks, seconds: float) -> bool:
    """Wait for an order without keeping a CPU busy; whether one came."""
    deadline = time.monotonic() + seconds
    while not ranks.comm.iprobe(source=0, tag=_ORDER):
        if time.monotonic() > deadline:
            return False
        time.sleep(_IDLE_SECONDS)
    return True


class Spent(NamedTuple):
    """What ranks spent on a solve, the mean and the largest; nothing on one rank."""

    seconds: Mapping[str, tuple[float, float]] = {}
    counts: Mapping[str, tuple[float, float]] = {}
    network: Mapping[str, tuple[float, float]] = {}  #: as each of them measured it

    def fields(self) -> dict[str, Any]:
        """Name the tables as fields of a record."""
        return {f"rank_{name}": table for name, table in self._asdict().items()}


class OnRanks:
    """A solver on rank 0, which has the others do their share, or the same.

    Attributes
    ----------
    spent : what the last solve cost the ranks

    """

    def __init__(
        self, solver: Solver, ranks: Ranks, emit: Emit, *, copies: bool = False
    ) -> None:
        self._solver = self.__wrapped__ = solver  # its file is that of failures
        self._ranks = ranks
        self._emit = emit
        self._emitted: DistributedQP | None = None
        self._unemitted: Exception | None = None
        self._copies = copies
        self._path = Path()
        self._memory_limit: float | None = None
        self.spent = Spent()
        self._own: Solution | None = None

    def shares(
        self, case: Mapping[str, Any], memory_limit: float | None
    ) -> tuple[QP, dict[str, Any]]:
        """Have all ranks make their shares of the next QP.

        Returns
        -------
        its sizes, as a QP without content; and what is to be told of it: its `sizes`,
        its `digest` and the seconds that the slowest rank took. Where ranks fail to
        emit it, a QP of no size: what is wrong is said when it is to be solved.

        """
        self._order({"case": dict(case), "memory_limit": memory_limit})
        self._emitted = self._unemitted = self._own = None
        try:
            self._emitted, told = _emitted(self._emit, case, self._ranks)
        except (InputError, RankFailedError) as e:
            self._unemitted = e
            return without_content(0, 0), {
                "sizes": {}, "digest": "", "build_seconds": None
            }  # fmt: skip
        of = self._emitted
        return without_content(of.variables, of.equality_rows), told

    def evaluated(self) -> dict[str, Any] | None:
        """Have all ranks evaluate the last answer, if they emitted its QP; see there.

        Returns
        -------
        as `harness.verify.verdicts.evaluated_by_ranks`

        """
        if self._emitted is None or self._own is None:
            return None
        self._order({"evaluate": True})
        return evaluated_by_ranks(self._emitted, self._own, self._ranks)

    def takes(self, path: Path, memory_limit: float | None) -> None:
        """Say in which file the next QP is, which is not emitted."""
        self._emitted = self._unemitted = self._own = None
        self._path, self._memory_limit = path, memory_limit

    def end(self) -> None:
        """Let the others end."""
        self._order(None)

    @property
    def accepts(self) -> tuple[type, ...]:
        """The convex sets that the solver declares."""
        return getattr(self._solver, "accepts", (Box,))

    def declines(self, qp: QP) -> str | None:
        """Decline what cannot be shared, besides what the solver declines."""
        if self._copies:
            return self._solver.declines(qp)
        if not getattr(self._solver, "on_ranks", False):
            return "runs in one process only; expected one rank"
        if self._unemitted is not None:  # other failures show when it is prepared
            of_input = isinstance(self._unemitted, InputError)
            return str(self._unemitted) if of_input else None
        if self._emitted is not None:
            self._order({"declines": True})
            return self._solver.declines(self._emitted.share().qp)
        product = qp.P.build() if isinstance(qp.P, SerialisableOperator) else None
        if not isinstance(product, Distributable):
            return "P cannot be shared by ranks; expected a case in subdomains"
        if product.parts < self._ranks.size:
            return (
                f"{self._ranks.size} ranks for {product.parts} subdomains; expected at "
                "most one rank for each"
            )
        return self._solver.declines(qp)

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        """Prepare on all ranks; it is done when the last one is."""
        if self._unemitted is not None:
            raise self._unemitted
        if self._emitted is not None:
            self._order({"tol": tol})
            share = self._emitted.share()
        else:
            order = {
                "qp": str(self._path), "tol": tol, "memory_limit": self._memory_limit,
                "copies": self._copies,
            }  # fmt: skip
            self._order(order)
            share = _share(qp, self._ranks, copies=self._copies)
        run = self._solver.prepare(share.qp, tol)
        self._ranks.comm.Barrier()

        def solve() -> Solution:
            self._order({})
            self._own, found = _solved(run, share, self._ranks)
            assert found is not None  # this is rank 0
            solution, spent = found
            self.spent = Spent() if self._copies else spent
            return solution

        return solve

    def _order(self, order: dict[str, Any] | None) -> None:
        for rank in range(1, self._ranks.size):
            self._ranks.comm.send(order, dest=rank, tag=_ORDER)


def _emitted(
    emit: Emit, case: Mapping[str, Any], ranks: Ranks
) -> tuple[DistributedQP, dict[str, Any]]:
    """Emit on all ranks, and tell of it what `OnRanks.shares` does.

    Raises
    ------
    InputError, RankFailedError
        On all ranks; the first as the family raises it.

    """
    start = time.perf_counter()
    try:
        made = run_collectively(
            ranks, lambda: emit(case, ranks)
        )  # by then the slowest is done
        seconds = time.perf_counter() - start
        digest = run_collectively(ranks, made.digest)
        told = {"sizes": made.sizes, "digest": digest, "build_seconds": seconds}
        return made, told
    except InputError:
        raise
    except Exception as e:
        why = str(e) if isinstance(e, RankFailedError) else in_a_line(e)
        raise RankFailedError(f"emission: {why}") from e


def without_content(variables: int, equality_rows: int) -> QP:
    """Make a QP with the sizes of one that no process has; it holds no numbers."""
    n, m = variables, equality_rows
    nothing = np.broadcast_to(0.0, n)
    return QP(
        P=LinearOperator((n, n), matvec=lambda x: 0 * x, dtype=float),
        q=nothing, lb=nothing, ub=nothing, G=no_rows(n), h=np.zeros(0),
        A=csr_array((m, n)), b=np.zeros(m),
    )  # fmt: skip


def _share(qp: QP, ranks: Ranks, *, copies: bool) -> Share:
    if copies:
        return Share(qp, lambda solution: solution if ranks.rank == 0 else None)
    product = qp.P.build()
    assert isinstance(product, Distributable)
    return product.share(qp, ranks)


def _solved(
    run: Callable[[], Solution], share: Share, ranks: Ranks
) -> tuple[Solution, tuple[Solution, Spent] | None]:
    """Solve: a slice of the solution, and on rank 0 all of it and what was spent."""
    ranks.clear()
    s = run()
    seconds, counts = dict(ranks.seconds), dict(ranks.counts)
    found = share.whole(s)
    peak = memory_mib("VmHWM") or 0.0
    told = ranks.comm.gather((seconds, counts, dict(ranks.network), peak))
    if found is None or told is None:
        return s, None
    *tables, peaks = zip(*told, strict=True)
    reported = {
        **found.reported, "ranks": ranks.size,
        "rank_peak_mib_largest": max(peaks),
        "rank_peak_mib_mean": sum(peaks) / ranks.size,
    }  # fmt: skip
    spent = Spent(*map(_mean_and_largest, tables))
    return s, (replace(found, reported=reported), spent)


def _mean_and_largest(
    each: Sequence[Mapping[str, float]],
) -> dict[str, tuple[float, float]]:
    values = {name: [float(one[name]) for one in each] for name in each[0]}
    return {name: (sum(v) / len(v), max(v)) for name, v in values.items()}
