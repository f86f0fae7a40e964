"""The process that one solver lives in, between measurements too.

It answers the requests of `harness.processes.protocol` with these of its own:

* the warm-up solves tiny QPs, so that imports which a solver puts off until its first
  solve are not timed
* ``{"qp": PATH, "tol": TOL, "out": PATH}``: it maps the QP into memory, measures, and
  writes the point to `out`. Optional: ``digest`` of the file, which is checked, and
  without which the file may hold no operator; ``memory_limit`` in MiB;
  ``sample_seconds``, see `harness.verify.measure`; ``step`` 0, 1, … of a sequence, and
  whether it ``tightens``: then every step comes with its own tolerance
* ``{"case": {…}, "source": …, "tol": TOL, "out": PATH}``: the same on ranks which
  emit the QP of a case themselves (`harness.plugin.Family.emission`), and evaluate the
  answer together if that is asked for. It says ``emitted`` when the QP is there, with
  its ``sizes`` and ``digest``, and ``measured`` when the point is written
* ``{"check": NAME}``: it runs one of `harness.conformance.conformance.CHECKS`

Every measurement loads its QP afresh, so that nothing that a solver did to the last one
is left.
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
from statistics import median
from time import perf_counter
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
from mortarbench.harness.processes.ranks import ParallelSolver, RankCosts, follow
from mortarbench.harness.qp import QP, Vector, no_rows
from mortarbench.harness.record import finite, journal_name
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify.measure import Prepare, Timed, measure, memory_mib

_MAX_BALLAST = 2**18  #: numbers, 2 MiB: never touched, so never resident


def serve(
    solver: Solver,
    request_fd: int,
    reply_fd: int,
    operators: Mapping[str, Maker] = NO_MAKERS,
    ranks: Ranks | None = None,
    emit: Emit | None = None,
    *,
    copies: bool = False,
) -> None:
    """Answer requests until there are no more.

    operators : what puts an operator P of a request together, see `harness.operators`
    ranks : that solve together, this process being one of them
    emit : has ranks emit the case of a request
    copies : each of them solves by itself instead, all at the same time
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
    bench.parallel = ParallelSolver(solver, ranks, emit, copies=copies)
    answer_requests(bench.answer, bench.warm_up, request_fd, reply_fd)
    bench.parallel.end()


class _SolverHost:
    """One solver, what it was handed last, and the sequence that it is in."""

    def __init__(self, solver: Solver, operators: Mapping[str, Maker]) -> None:
        self._solver = solver
        self._operators = operators
        self._chain: Callable[[QP, float], Callable[[], Solution]] | None = None
        self._at = -1  # the step of the sequence that came last
        self._verified_files: dict[str, tuple[int, ...]] = {}  # files by digest
        self._ballast = np.empty(0)
        self.parallel: ParallelSolver | None = (
            None  #: what measures in place of the solver
        )

    def warm_up(self) -> dict[str, Any]:
        """Solve a QP with bounds and one with rows; how that ends will show later.

        A chain of springs, long enough for every branch of a solver to be taken once:
        what is compiled, or loaded, at its first use must not be timed.
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
            _measure_in_process(self._solver, QP(P=P, **pull, **rows), 1e-6)
        canary_seconds()
        gc.freeze()  # the modules that are loaded by now need no further collecting
        return {"threads": _one_thread(), "cpus": sorted(os.sched_getaffinity(0))}

    def answer(self, request: dict[str, Any], events: Events) -> dict[str, Any]:
        """Measure once, or run one check."""
        if "check" in request:
            from mortarbench.harness.conformance.conformance import (
                run_check,  # few ask for it
            )

            events.start()
            return dict(run_check(request["check"], self._solver)._asdict())
        # Arrays lie elsewhere than they did during the last measurement. Where they
        # begin relative to a cache line is chance, but would be the same for as long as
        # the process lives: two processes of one solver then differ by 10 % and more,
        # however often they are measured (Mytkowicz et al., ASPLOS 2009). Varied, it is
        # scatter, which intervals know.
        self._ballast = np.empty(0)
        with suppress(AttributeError):  # glibc only
            ctypes.CDLL(None).malloc_trim(0)  # or freed pieces are used where they lie
        self._ballast = np.empty(random.randrange(_MAX_BALLAST))
        source = source_of(request)
        if source.is_shared:
            assert self.parallel is not None
            qp, told = self.parallel.emit(request["case"], request.get("memory_limit"))
            events.reached("emitted", told)
        else:
            qp = self._load(request)
        canary = canary_seconds()
        _limit_memory(request.get("memory_limit"))
        timed = _measure_in_process(
            self.parallel or self._solver,
            qp,
            request["tol"],
            prepare=self._step(request),
            sample_seconds=request.get("sample_seconds", 0.0),
            starts=events.start,
            ends=events.timed,
        )
        _limit_memory(None)
        s = timed.solution
        write_point(Path(request["out"]), s)
        spent = RankCosts() if self.parallel is None else self.parallel.spent
        evaluated = dict[str, Any]()
        if source.is_shared and self.parallel is not None:
            events.reached("measured", {})
            judges = source is Source.RANKS
            found = self.parallel.evaluate() if judges else None
            evaluated = {"evaluated": found}
        return {
            **evaluated,
            "claimed": s.status,
            "message": s.message,
            "iterations": s.iterations,
            "counts": s.counts,
            "reported": finite(dict(s.reported)),
            "first_seconds": timed.first_seconds,
            # fields of the record that the parent takes as they are
            "record": {"canary_seconds": canary, **spent.fields()},
            **{journal_name(k): v for k, v in asdict(timed.cost).items()},
        }

    def _load(self, request: dict[str, Any]) -> QP:
        path, digest = Path(request["qp"]), request.get("digest")
        if digest is not None:
            at = path.stat()  # a file that has not changed is known
            seen = (at.st_ino, at.st_size, at.st_mtime_ns)
            if self._verified_files.get(digest) != seen:
                if content_digest(path) != digest:
                    raise ValueError(f"{path.name} was changed on disk")
                self._verified_files[digest] = seen
        vouched = digest is not None  # or it may be anybody's
        qp, _ = load_qp(path, operators=self._operators if vouched else None)
        if self.parallel is not None:
            self.parallel.use_file(path, request.get("memory_limit"))
        return qp

    def _step(self, request: dict[str, Any]) -> Prepare | None:
        """Begin a sequence at its first step, and go on with it at the others."""
        step = request.get("step")
        if step is None or not hasattr(self._solver, "chain"):
            return None
        if step and self._at != step - 1:
            raise LookupError("the process that drove the sequence so far has gone")
        self._at, tol = step, request["tol"]
        if step == 0:
            self._chain = None
        begin = partial(
            _begin_sequence, self._solver, tightens=request.get("tightens", False)
        )

        def prepare(qp: QP) -> Callable[[], Solution]:
            if self._chain is None:  # on the clock, as its step is
                self._chain = begin(tol)
            return self._chain(qp, tol)

        return prepare


def _begin_sequence(
    solver: Any, tol: float, *, tightens: bool
) -> Callable[[QP, float], Callable[[], Solution]]:
    """Begin a sequence whose steps all have that tolerance, or each its own."""
    if not tightens:
        same: Prepare = solver.chain(tol)
        return lambda qp, tol: same(qp)
    if hasattr(solver, "tightening"):
        own: Callable[[QP, float], Callable[[], Solution]] = solver.tightening()
        return own
    why = "its chain() has one tolerance for all steps; tightening() would take others"
    return lambda qp, tol: partial(Solution.without_point, qp, Status.DECLINED, why)


def canary_seconds() -> float:
    """Time a fixed small kernel, the median of five: a drift of it is the machine's."""
    matrix, vector = _aligned(128 * 128).reshape(128, 128), _aligned(128)
    times = []
    for _ in range(5):
        start = perf_counter()
        for _ in range(10):
            matrix @ vector
        times.append(perf_counter() - start)
    return median(times)


def _aligned(count: int) -> Vector:
    """Make ones that begin with a cache line, so that chance does not move them."""
    room = np.ones(count + 8)
    start = -room.ctypes.data % 64 // 8
    return room[start : start + count]


def _one_thread() -> int:
    """Return the most threads of any library, after setting those that can be set."""
    libraries = ThreadpoolController()
    libraries.limit(limits=1)
    return max((pool["num_threads"] for pool in libraries.info()), default=1)


def _limit_memory(mib: float | None) -> None:
    """Have allocations fail that would exceed `mib`; None lifts the limit.

    The parent looks at what is resident and kills; that comes too late for a single
    allocation beyond all memory. RLIMIT_DATA counts what is there already as well.
    """
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    soft = hard
    if mib is not None and (data := memory_mib("VmData")) is not None:
        soft = int((data + mib) * 2**20)
        if hard != resource.RLIM_INFINITY:
            soft = min(soft, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def _measure_in_process(
    solver: Solver, qp: QP, tol: float, *, ends: Callable[[], None] = lambda: None,
    **how: Any,
) -> Timed:  # fmt: skip
    """Measure; a child that the solver forked and let return to us ends here."""
    process = os.getpid()

    def ends_here() -> None:
        if os.getpid() != process:
            os._exit(0)
        ends()

    return measure(solver, qp, tol, ends=ends_here, **how)
