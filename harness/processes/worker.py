"""Process that executes all measurements of one solver.

The process follows `harness.processes.protocol`. In its warm-up, the process solves
tiny QPs, so that imports during the first solve of a solver are not timed. The process
answers three kinds of requests:

* ``{"qp": PATH, "tol": TOL, "out": PATH}``: map the QP into memory, measure, and write
  the point to ``out``. Optional entries are

  - ``digest``: digest of the file, which is checked; without a digest, QPs with an
    operator are refused,
  - ``memory_limit``: limit in MiB,
  - ``once``: true for a single solve, which is timed,
  - ``step``: index 0, 1, … of the QP in a sequence, and
  - ``tightens``: true if each step of the sequence has its own tolerance

* ``{"case": {…}, "source": …, "tol": TOL, "out": PATH}``: emit the QP of a case on the
  MPI ranks (`harness.plugin.Family.emission`), measure, and write the point to ``out``.
  If the request has the entry ``first``, the ranks emit the case in that entry
  beforehand. If ``source`` is "ranks", the ranks also evaluate the answer. The event
  ``emitted`` contains the ``sizes``, the ``digest`` and the ``build_seconds`` of the
  QP; the event ``measured`` is sent when the point has been written
* ``{"check": NAME}``: run one of `harness.conformance.conformance.CHECKS`

Every measurement loads the QP again, so that modifications by a solver do not affect
later measurements.
"""

from __future__ import annotations

import ctypes
import gc
import os
import random
import resource
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController

from mortarbench.harness.distributed.vectors import Emit, Ranks
from mortarbench.harness.files.qpfile import load_qp
from mortarbench.harness.files.store import write_point
from mortarbench.harness.operators import NO_MAKERS, Maker
from mortarbench.harness.plugin import Solver
from mortarbench.harness.processes.case_folder import content_digest
from mortarbench.harness.processes.protocol import (
    Events,
    Source,
    answer_requests,
    source_of,
)
from mortarbench.harness.processes.ranks import ParallelSolver, follow
from mortarbench.harness.qp import QP, no_rows
from mortarbench.harness.record import finite, journal_name
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify.measure import (
    DeclinedError,
    Prepare,
    SolverError,
    measure,
    memory_mib,
    solve_once,
)

#: Largest number of doubles (2 MiB) in the array that shifts addresses between
#: measurements. The pages of the array are never touched and take no memory.
_MAX_BALLAST = 2**18


def serve(
    solver: Solver,
    request_fd: int,
    reply_fd: int,
    operators: Mapping[str, Maker] = NO_MAKERS,
    ranks: Ranks | None = None,
    emit: Emit | None = None,
) -> None:
    """Answer requests until the pipe of requests is closed.

    operators : makers of operators P by name, see `harness.operators`
    ranks : communicator of the ranks that solve together; None in a single process
    emit : assembles the local share of a case on each rank
    """
    bench = _SolverHost(solver, operators)
    if ranks is None or emit is None:
        answer_requests(bench.answer, bench.warm_up, request_fd, reply_fd)
        return
    if ranks.rank:
        os.close(request_fd)
        os.close(reply_fd)
        bench.warm_up()
        follow(solver, ranks, operators, emit, _limit_memory)
        return
    bench.parallel = ParallelSolver(solver, ranks, emit)
    answer_requests(bench.answer, bench.warm_up, request_fd, reply_fd)
    bench.parallel.end()


class _SolverHost:
    """Solver with the state that persists between requests, such as a sequence."""

    def __init__(self, solver: Solver, operators: Mapping[str, Maker]) -> None:
        self._solver = solver
        self._operators = operators
        self._chain: Callable[[QP, float], Callable[[], Solution]] | None = None
        self._last_step = -1  # index of the last measured step of the sequence
        # inode, size and modification time of each verified file, by the digest of its
        # content
        self._verified_files: dict[str, tuple[int, ...]] = {}
        self._ballast = np.empty(0)
        #: on several ranks, replaces the solver in measurements
        self.parallel: ParallelSolver | None = None

    def warm_up(self) -> dict[str, Any]:
        """Solve a QP with bounds, and one with bounds and rows; ignore the results.

        Code that is compiled or loaded at its first use must not be timed. The QPs
        model a chain of springs, long enough for solvers to enter most of their
        branches.
        """
        n = 32
        P = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
        pull: dict[str, Any] = dict(
            q=np.cos(np.arange(n)), lb=np.zeros(n), ub=np.full(n, np.inf)
        )
        one, ones = np.eye(n)[:1], np.ones((1, n))
        no_row = dict(A=no_rows(n), b=np.zeros(0), G=no_rows(n), h=np.zeros(0))
        one_row_each = dict(A=ones, b=np.ones(1), G=one, h=np.ones(1))
        for rows in (no_row, one_row_each):
            with suppress(DeclinedError, SolverError):
                solve_once(self._solver, QP(P=P, **pull, **rows), 1e-6)
        gc.freeze()  # exclude the loaded modules from collections during measurements
        return {"threads": _one_thread(), "cpus": sorted(os.sched_getaffinity(0))}

    def answer(self, request: dict[str, Any], events: Events) -> dict[str, Any]:
        """Answer one request: measure once, or run one check."""
        if "check" in request:
            from mortarbench.harness.conformance.conformance import (
                run_check,  # few requests need it
            )

            events.start()
            return dict(run_check(request["check"], self._solver)._asdict())
        # Place the arrays at different addresses in each measurement. Otherwise, their
        # alignment to cache lines is random but fixed for the life of the process. The
        # times of two processes of one solver may then differ by 10 % or more, however
        # often they are measured (Mytkowicz et al., ASPLOS 2009). A varying alignment
        # converts this bias into scatter, which confidence intervals include.
        self._ballast = np.empty(0)
        with suppress(AttributeError):  # malloc_trim exists only in glibc
            # otherwise the allocator would reuse freed blocks at their old addresses
            ctypes.CDLL(None).malloc_trim(0)
        self._ballast = np.empty(random.randrange(_MAX_BALLAST))
        source = source_of(request)
        if source.is_shared:
            assert self.parallel is not None
            limit = request.get("memory_limit")
            if "first" in request:
                self.parallel.emit(request["first"], limit)
            qp, emission = self.parallel.emit(request["case"], limit)
            events.reached("emitted", emission)
        else:
            qp = self._load(request)
        _limit_memory(request.get("memory_limit"))
        timed = measure(
            self.parallel or self._solver,
            qp,
            request["tol"],
            prepare=self._step(request),
            once=request.get("once", False),
            perturbs=self.parallel is None,  # ranks assemble their shares of the QP
            starts=events.start,
            solved=events.solved,
            ends=events.timed,
        )
        _limit_memory(None)
        s = timed.solution
        write_point(Path(request["out"]), s)
        evaluated = dict[str, Any]()
        if source.is_shared and self.parallel is not None:
            events.reached("measured", {})
            is_judge = source is Source.RANKS
            evaluated = {"evaluated": self.parallel.evaluate() if is_judge else None}
        return {
            **evaluated,
            "claimed": s.status,
            "message": s.message,
            "iterations": s.iterations,
            "counts": s.counts,
            "reported": finite(dict(s.reported)),
            "worked_seconds": timed.worked_seconds,
            "solves": timed.solves,
            **{journal_name(k): v for k, v in asdict(timed.cost).items()},
        }

    def _load(self, request: dict[str, Any]) -> QP:
        path, digest = Path(request["qp"]), request.get("digest")
        if digest is not None:
            status = path.stat()
            # hash the file again only if inode, size or time have changed
            version = (status.st_ino, status.st_size, status.st_mtime_ns)
            if self._verified_files.get(digest) != version:
                if content_digest(path) != digest:
                    raise ValueError(f"{path.name} was changed on disk")
                self._verified_files[digest] = version
        # A file without a digest may have any origin, so its operators are not built.
        is_ours = digest is not None
        qp, _ = load_qp(path, operators=self._operators if is_ours else None)
        if self.parallel is not None:
            self.parallel.use_file(path, request.get("memory_limit"))
        return qp

    def _step(self, request: dict[str, Any]) -> Prepare | None:
        """Return the `prepare` function of a step; step 0 begins a new sequence.

        The result is None if the request is not a step of a sequence, or if the solver
        treats each step as an independent QP.
        """
        step = request.get("step")
        if step is None or not hasattr(self._solver, "chain"):
            return None
        if step and self._last_step != step - 1:
            raise LookupError("the process with the earlier steps has ended")
        self._last_step, tol = step, request["tol"]
        if step == 0:
            self._chain = None
        begin = partial(
            _begin_sequence, self._solver, tightens=request.get("tightens", False)
        )

        def prepare(qp: QP) -> Callable[[], Solution]:
            # Begin the sequence here, so that its time is included in the time of
            # `prepare`.
            if self._chain is None:
                self._chain = begin(tol)
            return self._chain(qp, tol)

        return prepare


def _begin_sequence(
    solver: Any, tol: float, *, tightens: bool
) -> Callable[[QP, float], Callable[[], Solution]]:
    """Return the `prepare` function of a sequence, called with each QP and tolerance.

    tightens : True if each step has its own tolerance; if the solver does not support
        varying tolerances, every step is declined
    """
    if not tightens:
        fixed: Prepare = solver.chain(tol)
        return lambda qp, tol: fixed(qp)
    if hasattr(solver, "tightening"):
        varying: Callable[[QP, float], Callable[[], Solution]] = solver.tightening()
        return varying
    why = (
        "chain() uses one tolerance for all steps; expected tightening() for several "
        "tolerances"
    )
    return lambda qp, tol: partial(Solution.without_point, qp, Status.DECLINED, why)


def _one_thread() -> int:
    """Limit all thread pools to one thread; return the largest pool size afterwards."""
    libraries = ThreadpoolController()
    libraries.limit(limits=1)
    return max((pool["num_threads"] for pool in libraries.info()), default=1)


def _limit_memory(mib: float | None) -> None:
    """Limit the memory that this process may allocate from now on.

    The parent polls resident memory and kills workers above the limit. For a single
    allocation that exceeds the memory of the machine, this is too late.

    mib : limit in MiB; None lifts the limit
    """
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    soft = hard
    # RLIMIT_DATA includes memory that is already allocated.
    if mib is not None and (data := memory_mib("VmData")) is not None:
        soft = int((data + mib) * 2**20)
        if hard != resource.RLIM_INFINITY:
            soft = min(soft, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))
