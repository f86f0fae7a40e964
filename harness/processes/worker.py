"""Process that builds cases, measures a solver, and evaluates answers.

The process follows `harness.processes.protocol` and answers these requests:

* ``{"qp": PATH, "digest": DIGEST, "tol": TOL, "out": PATH}``: map the QP into memory
  after a check of the file's digest, measure, and write the point to ``out``. Optional
  entries are

  - ``memory_limit``: limit in MiB,
  - ``once``: true for a single solve, which is timed, and
  - ``step``: index 0, 1, … of the QP in a sequence

* ``{"case": {…}, "tol": TOL, "judged_at": TOL, "out": PATH}``: build a case on the MPI
  ranks (`harness.plugin.Family.divided`), measure, write the point to ``out``, and
  judge the answer at the tolerance ``judged_at``, unless this is null. With ``point``,
  the path of a point, and the solver's claim ``claimed`` instead of ``tol`` and
  ``out``, the ranks only judge this point. The event ``built`` contains the fields
  ``sizes``, ``qp`` and ``build_seconds`` of the record; the event ``measured`` is sent
  when the point has been written
* ``{"build": …}`` and ``{"describe": …}``: see `harness.processes.cases`
* ``{"check": NAME}``: run one of `harness.conformance.conformance.CHECKS`

In its warm-up, a process with a solver solves tiny QPs, so that imports during the
first solve are not timed. Every measurement loads the QP again, so that modifications
by a solver do not affect later measurements.
"""

from __future__ import annotations

import ctypes
import gc
import os
import random
import resource
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController

from mortarbench.harness.files.mapped import content_digest
from mortarbench.harness.files.qpfile import load_qp
from mortarbench.harness.files.store import read_point, write_point
from mortarbench.harness.operators import NO_MAKERS, Maker
from mortarbench.harness.plugin import Solver
from mortarbench.harness.processes.cases import Cases
from mortarbench.harness.processes.protocol import (
    Send,
    answer_requests,
)
from mortarbench.harness.processes.ranks import Build, Ranks
from mortarbench.harness.qp import QP, no_rows
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
    worker: Worker, request_fd: int, reply_fd: int, build: Build | None = None
) -> None:
    """Answer requests until the pipe of requests is closed.

    build : builds a case on MPI ranks; None in a single process
    """
    if build is None:
        answer_requests(worker.answer, request_fd, reply_fd)
        return
    ranks = worker.ranks = Ranks(build, _limit_memory)
    if ranks.team.comm.rank:
        os.close(request_fd)
        os.close(reply_fd)
        worker.warm_up()
        ranks.team.serve()
        return
    answer_requests(worker.answer, request_fd, reply_fd)
    ranks.team.end()


@dataclass(eq=False, kw_only=True)
class Worker:
    """Solver and cases of a worker, with the state that persists between requests.

    operators : makers of operators P by name, see `harness.operators`
    """

    solver: Solver | None = None  #: solver to measure; None if only cases are built
    cases: Cases | None = None  #: None if only a solver is measured
    operators: Mapping[str, Maker] = field(default_factory=lambda: NO_MAKERS)
    #: the MPI ranks that solve together; None in a single process
    ranks: Ranks | None = None
    _chain: Prepare | None = None  # solver of the current sequence
    _last_step: int = -1  # index of the last measured step of the sequence
    _ballast: Any = None  # array that shifts the addresses of other arrays

    def answer(self, request: dict[str, Any], send: Send) -> Mapping[str, Any]:
        """Answer one request; `send` sends the events before the last one."""
        if "warm_up" in request:
            return self.warm_up()
        if "out" in request:
            return self._measure(request, send)
        if "point" in request and self.ranks is not None:
            send("built", **self.ranks.build(request["case"]))
            send("start")
            s = read_point(Path(request["point"]), Status(request["claimed"]))
            return self.ranks.judge(s, request["judged_at"])
        send("start")
        if "check" in request:
            # few requests need this import
            from mortarbench.harness.conformance.conformance import run_check

            assert self.solver is not None
            return run_check(request["check"], self.solver)._asdict()
        assert self.cases is not None
        return self.cases.answer(request)

    def warm_up(self) -> dict[str, Any]:
        """Solve a QP with bounds, and one with bounds and rows; ignore the results.

        Code that is compiled or loaded at its first use must not be timed. The QPs
        model a chain of springs, long enough for solvers to enter most of their
        branches.

        Returns
        -------
        the number of threads, and the CPU to which the process is bound, if unique

        """
        n, solver = 32, self.solver
        P = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
        pull: dict[str, Any] = dict(
            q=np.cos(np.arange(n)), lb=np.zeros(n), ub=np.full(n, np.inf)
        )
        one, ones = np.eye(n)[:1], np.ones((1, n))
        no_row = dict(A=no_rows(n), b=np.zeros(0), G=no_rows(n), h=np.zeros(0))
        one_row_each = dict(A=ones, b=np.ones(1), G=one, h=np.ones(1))
        for rows in (no_row, one_row_each):
            with suppress(DeclinedError, SolverError):
                if solver is not None:
                    solve_once(solver, QP(P=P, **pull, **rows), 1e-6)
        gc.freeze()  # exclude the loaded modules from collections during measurements
        cpus = sorted(os.sched_getaffinity(0))
        return {"threads": _one_thread(), "cpu": cpus[0] if len(cpus) == 1 else None}

    def _measure(self, request: dict[str, Any], send: Send) -> dict[str, Any]:
        # Place the arrays at different addresses in each measurement. Otherwise, their
        # alignment to cache lines is random but fixed for the life of the process. The
        # times of two processes of one solver may then differ by 10 % or more, however
        # often they are measured (Mytkowicz et al., ASPLOS 2009). A varying alignment
        # converts this bias into scatter, which confidence intervals include.
        self._ballast = None
        with suppress(AttributeError):  # malloc_trim exists only in glibc
            # otherwise the allocator would reuse freed blocks at their old addresses
            ctypes.CDLL(None).malloc_trim(0)
        self._ballast = np.empty(random.randrange(_MAX_BALLAST))
        assert self.solver is not None
        ranks, solver = self.ranks, self.solver
        set_limit: Callable[[float | None], object] = _limit_memory
        if ranks is not None:
            send("built", **ranks.build(request["case"]))
            solver, qp = ranks.problem(solver)
            set_limit = partial(ranks.call, "limit")
        else:
            path = Path(request["qp"])
            if content_digest(path) != request["digest"]:
                raise ValueError(f"{path.name}: was changed on disk")
            qp, _ = load_qp(path, operators=self.operators)
        set_limit(request.get("memory_limit"))
        timed = measure(
            solver,
            qp,
            request["tol"],
            prepare=self._step(request),
            once=request.get("once", False),
            starts=partial(send, "start"),
            solved=partial(send, "solved"),
            ends=partial(send, "timed"),
        )
        set_limit(None)
        s, judged = timed.solution, dict[str, Any]()
        if ranks is not None:
            s = replace(s, reported={**s.reported, **ranks.reported()})
        write_point(Path(request["out"]), s)
        if ranks is not None:
            send("measured")
            if request["judged_at"] is not None:
                judged = ranks.judge(s, request["judged_at"])
        return {
            **judged,
            "claimed": s.status,
            "message": s.message,
            "iterations": s.iterations,
            "counts": s.counts,
            "reported": dict(s.reported),
            "worked_seconds": timed.worked_seconds,
            "solves": timed.solves,
            "cost": timed.cost,
        }

    def _step(self, request: dict[str, Any]) -> Prepare | None:
        """Return the `prepare` function of a step; step 0 begins a new sequence.

        The result is None if the request is not a step of a sequence, or if the solver
        treats each step as an independent QP.
        """
        step = request.get("step")
        begin = getattr(self.solver, "chain", None)
        if step is None or begin is None:
            return None
        if step and self._last_step != step - 1:
            raise LookupError("the process with the earlier steps has ended")
        self._last_step, tol = step, request["tol"]
        if step == 0:
            self._chain = None

        def prepare(qp: QP) -> Callable[[], Solution]:
            # Begin the sequence here, so that its time is included in the time of
            # `prepare`.
            if self._chain is None:
                self._chain = begin(tol)
            return self._chain(qp)

        return prepare


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
