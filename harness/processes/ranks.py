"""Workers on several MPI ranks, and the process that starts them.

Runs start `launch` in place of a worker. `launch` calls `mpiexec`, which starts the
worker's command on every rank. The ranks inherit the pipes to the parent. Rank 0 is the
worker of `harness.processes.worker` and communicates with the parent; the other ranks
execute orders that rank 0 sends. Each rank has its own CPU if there are enough CPUs.
The memory limit applies to the sum over all ranks. If one rank ends, all other ranks
are ended.

Rank 0 runs the ordinary worker, which builds the case, and places the subdomains on all
ranks (`harness.distributed.comm`).
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from mortarbench.harness.distributed.comm import (
    PEER_TIMEOUT,
    RECORD,
    Placed,
    RankFailedError,
    Team,
    world,
)
from mortarbench.harness.distributed.mpi import MISSING, mpiexec
from mortarbench.harness.environment.cpus import fastest_first
from mortarbench.harness.errors import InputError, described
from mortarbench.harness.plugin import Case, Solver
from mortarbench.harness.processes import parent
from mortarbench.harness.qp import QP
from mortarbench.harness.record import Verdict
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify.measure import memory_mib
from mortarbench.harness.verify.verdicts import evaluated, has_point


def launch(ranks: int, command: Sequence[str]) -> int:
    """Run `command` on several MPI ranks, and report on stderr if a rank failed.

    A parent process of each rank writes a line when the rank has ended
    (`harness.processes.parent`), and mpiexec ends the other ranks after that. The first
    line therefore names the rank that ended first. The other ranks are also ended,
    after `PEER_TIMEOUT`, if the rank exits with 0. The output of the ranks is not
    parsed, since its lines may be interleaved.

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
    # Use all CPUs of the run again: the parent process bound only this process.
    os.sched_setaffinity(0, os.sched_getaffinity(os.getppid()))
    read, write = os.pipe()
    above = [sys.executable, "-I", "-S", parent.__file__, "rank", str(write)]
    process = subprocess.Popen(
        [start, "-n", str(ranks), *above, str(ranks), *command],
        stdin=subprocess.DEVNULL,
        pass_fds=(*fds, write),
        env=os.environ | {RECORD: str(write)},
    )
    # Close this process's copies of the pipe ends. Otherwise, readers would not receive
    # end of file after the ranks or the parent have closed their copies.
    for fd in (*fds, write):
        os.close(fd)
    with os.fdopen(read) as records:
        first = records.readline().strip()
    with suppress(subprocess.TimeoutExpired):
        process.wait(PEER_TIMEOUT)
    code = process.returncode
    # The parent quotes the last line of the output. The newline ends a possibly
    # unfinished line of a rank.
    how = first or f"one of {ranks} ranks ended: mpiexec exited with {code}"
    print(f"\n{how}", file=sys.stderr)
    return 0 if code == 0 else 1


#: builds the case of a request, a mapping with family, params and form, on rank 0
Build: TypeAlias = "Callable[[Mapping[str, Any], Team], Case]"


class Ranks:
    """State of one rank; rank 0 calls methods of this class on all ranks.

    Attributes
    ----------
    team : rank 0 and the ranks that serve
    case : the case; None on all ranks but rank 0, and after a failure
    failure : reason why the last build failed, else None
    call : calls a method of this class on all ranks, from rank 0

    """

    def __init__(self, build: Build, limit: Callable[[float | None], None]) -> None:
        """Join the other ranks, on a separate CPU if there are enough CPUs.

        limit : sets the memory limit of this process, in MiB; None removes the limit
        """
        comm, self._build, self.limit = world(), build, limit
        self.team = Team(comm, self)
        self.call = Placed(self.team, 0)
        self.case: Case | None = None
        self.failure: Exception | None = None
        cpus = fastest_first(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cpus[comm.rank % len(cpus)]})
        if RECORD in os.environ:
            os.set_inheritable(int(os.environ[RECORD]), False)

    def trim(self) -> None:
        """Return freed memory to the system; the build leaves tens of MiB."""
        ctypes.CDLL(None).malloc_trim(0)

    def peak(self) -> float:
        """Return the peak memory of this rank, in MiB."""
        return memory_mib("VmHWM") or 0.0

    def build(self, case: Mapping[str, Any]) -> dict[str, Any]:
        """Build a case; return the entries of the event "built".

        The entries are the `sizes` and the digest `qp` of the QP, and the time in s.
        They are empty after a failure.
        """
        start = time.perf_counter()
        self.case = self.failure = None
        self.call("peak")  # any order frees the objects of the last case on all ranks
        try:
            self.case = self._build(case, self.team)
        except (InputError, RankFailedError) as e:
            self.failure = e
        except Exception as e:
            self.failure = RankFailedError(described(e))
        if self.case is None:
            return {}
        seconds = time.perf_counter() - start
        with suppress(AttributeError):  # malloc_trim exists only in glibc
            self.call("trim")
        sizes, digest = self.case.qp.sizes, self.case.digest
        return {"sizes": sizes, "qp": digest, "build_seconds": seconds}

    def problem(self, solver: Solver) -> tuple[Solver, QP]:
        """Return the solver and the QP; after a failure, a solver that reports it."""
        if self.case is not None:
            return solver, self.case.qp
        assert self.failure is not None
        return _Unbuilt(self.failure), QP.from_arrays(np.eye(1), np.zeros(1))

    def reported(self) -> dict[str, float]:
        """Return the number and the peak memory of the ranks, for a solution."""
        peaks = self.call("peak")
        return {
            "ranks": len(peaks),
            "rank_peak_mib_largest": max(peaks),
            "rank_peak_mib_mean": sum(peaks) / len(peaks),
        }

    def judge(self, s: Solution, tol: float) -> dict[str, Any]:
        """Judge an answer with new factors.

        Returns
        -------
        ``fields``, the entries of a record with the verdict, and ``notes``

        """
        # after a failure of ranks, products would fail again
        if self.case is None or (s.status is Status.FAILED and not has_point(s)):
            return {"fields": {"status": Verdict(s.status)}, "notes": []}
        # factors that code of a solver may have reached are not used
        if hasattr(self.case.qp.P, "forget"):
            self.case.qp.P.forget()
        fields, notes = evaluated(self.case, s, tol)
        return {"fields": fields, "notes": [*filter(None, notes)]}


@dataclass(frozen=True)
class _Unbuilt:
    """Solver for a QP that the ranks could not build."""

    failure: Exception

    def declines(self, qp: QP) -> str | None:
        return str(self.failure) if isinstance(self.failure, InputError) else None

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        raise self.failure
