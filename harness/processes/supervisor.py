"""Supervision of a worker process: requests, limits and diagnosis of exits.

Only SIGKILL to all processes of a worker stops every solver, because Python handles an
alarm only after C code has returned, and some solvers ignore SIGTERM. A small parent
process above each worker (`harness.processes.parent`) keeps these processes in one tree
and kills them. Memory is limited by polling the resident size, because RLIMIT_AS
includes address space that libraries reserve and never touch. The module requires the
/proc file system of Linux.

All workers of a process share one CPU. Requests from several threads are therefore
serialised, and a worker that still uses CPU time after its answer is replaced, so that
running threads of one solver do not disturb the measurement of another solver.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from math import inf
from pathlib import Path
from select import select
from typing import Any, ClassVar
from weakref import WeakSet

import psutil

from mortarbench.harness import limits
from mortarbench.harness.environment.cpus import fastest_first
from mortarbench.harness.errors import one_line
from mortarbench.harness.processes import parent
from mortarbench.harness.processes.locks import ForkSafeLock
from mortarbench.harness.processes.protocol import (
    MAX_REPLY_BYTES,
    event_of,
)
from mortarbench.harness.record import Verdict

POLL_SECONDS = 0.02  #: time between two checks of the memory of a worker
START_SECONDS = 120.0  #: time limit for starting a worker, and for loading a QP
WARM_UP_SECONDS = 60.0  #: time limit of the warm-up
#: time limit of all solves after the first one, which took at most
#: `harness.verify.measure.MAX_UNTIMED_SECONDS`
REPEAT_SECONDS = 30.0
POINT_SECONDS = 120.0  #: time limit of writing the point of an answer
#: longest time between the closing of the pipe of requests and the exit of a worker,
#: after which the worker is killed
CLOSE_SECONDS = 1.0
#: longest time for which idle threads of pools may spin after an answer
SETTLE_SECONDS = 0.5
LOG_BYTES = 2**20  #: size above which the log of a worker is truncated
#: length to which the last line of the log is shortened in a message
MAX_LAST_LINE_CHARACTERS = 300
_LOG_TAIL_BYTES = 2**16  #: bytes at the end of the log in which its last line is sought
#: fraction of the memory limit above which a failure is attributed to lack of memory
MEMORY_LIMIT_SHARE = 0.9

_LOCK = ForkSafeLock()  #: held while a thread starts, ends or queries a worker

REPLACEMENT_NOTE = "the worker used CPU time after its answer, and was replaced"

#: Signals that solvers do not send to themselves. If such a signal ends a worker before
#: a solve, the worker was killed from outside.
_EXTERNAL_SIGNALS = ("SIGKILL", "SIGTERM", "SIGINT", "SIGHUP", "SIGQUIT")
#: last lines of output of processes that failed before a solve because of the machine
_MACHINE_FAILURE = re.compile(
    r"No space left on device|Disk quota exceeded|Too many open files"
    r"|Read-only file system|Input/output error|cannot be started"
)


@dataclass(frozen=True, kw_only=True)
class Reply:
    """Result of a request: the worker's answer, or the reason why there is none."""

    answer: Mapping[str, Any] | None = None
    #: verdict on the end of the worker; None if there is an answer or a fault
    verdict: Verdict | None = None
    fault: bool = False  #: True if the harness or the machine failed, not the solver
    message: str = ""  #: description of the failure, and notes
    #: True if the worker ended in a solve that repeats a completed solve
    in_repeats: bool = False
    peak_mib: float | None = None  #: largest memory that the parent observed
    #: wall time from the request to "timed"; None if the request is not a measurement
    elapsed_seconds: float | None = None
    threads: int | None = None  #: number of threads that the worker reported
    cpu: int | None = None  #: number of the CPU to which the worker is bound
    #: sizes, digest and build time of the QP that the worker built; None if it built
    #: no QP
    built: Mapping[str, Any] | None = None


class WorkerProcess:
    """Worker process, started by the first request and replaced after it has died.

    Two file descriptors, for requests and for replies, are appended to `command`. The
    worker runs in its own session, on the fastest CPU that this process may use.
    Environment variables set the thread pools of common libraries to one thread.
    The output of the worker goes to the file `log`.

    Several threads of a process may have workers, or share a worker: each request waits
    until the previous one is answered. Forks of this process own none of its workers.
    """

    _all: ClassVar[WeakSet[WorkerProcess]] = WeakSet()

    def __init__(self, command: list[str], log: Path) -> None:
        self._command = command
        self._log = log
        self._process: subprocess.Popen[bytes] | None = None  # the worker's parent
        self._worker: Any = None  # the worker as psutil.Process, once it is ready
        # file descriptors of the two pipes in this process
        self._requests = self._replies = -1
        self._unread = b""
        self._warms_up = True
        self._is_warm = False
        # number of threads and CPU that the worker reports after its warm-up
        self._facts: dict[str, Any] = {}
        self._peak_mib = 0.0
        self._built: dict[str, Any] | None = None  # entries of the event "built"
        with _LOCK:
            self._all.add(self)

    def judge(self) -> WorkerProcess:
        """Return a new worker that has no solver and only judges answers."""
        *start, request = self._command
        command = [*start, json.dumps({**json.loads(request), "judges": True})]
        return WorkerProcess(command, self._log.with_suffix(".judge"))

    @_LOCK
    def start(self) -> None:
        """Start the process without waiting for it; the first request reports errors.

        The worker then loads its libraries while this process does other work.
        """
        try:
            self._spawn(inf)
        except OSError:
            self._kill()

    @_LOCK
    def ask(
        self, request: Mapping[str, Any], *, time_limit: float, memory_limit: float
    ) -> Reply:
        """Send a request, enforce its limits, and return the answer or the diagnosis.

        If a process that has answered earlier requests dies before the solve starts,
        the request is repeated once in a new process, since an earlier solve may have
        damaged the old one.

        time_limit : limit in s, counted from the event "start", that is, after imports,
            warm-up and loading of the QP. The same limit applies to the build of the
            QP by the worker; the limit for its evaluation of the answer is at least
            `POINT_SECONDS`
        memory_limit : limit for all processes of the worker together, in MiB
        """
        self._peak_mib, self._built = 0.0, None
        while True:
            was_warm = self._is_warm
            try:
                self._start(memory_limit)
                answer, elapsed = self._exchange(request, time_limit, memory_limit)
                break
            except _WorkerEndError as end:
                self._kill()
                if not (end.is_early and was_warm):
                    return self._reply_to_end(end, memory_limit)
            except OSError as e:  # a process, pipe or log could not be created
                self._kill()
                return Reply(fault=True, message=one_line(str(e)))
        # the processes of a sequence remain between its steps
        keeps_ranks = "step" in request and "case" in request
        is_busy = self._is_busy()
        # processes that still run would disturb the next measurement
        if is_busy or (not keeps_ranks and self._has_children()):
            self._kill()
        message = REPLACEMENT_NOTE if is_busy else ""
        return self._reply(answer=answer, elapsed_seconds=elapsed, message=message)

    @_LOCK
    def close(self) -> None:
        """Close the pipe of requests; kill the worker if it does not exit in time.

        The time limit is `CLOSE_SECONDS`. A worker that has not answered a request is
        killed at once.
        """
        try:
            if self._process is not None and self._is_warm:
                os.close(self._requests)
                self._requests = -1
                with suppress(subprocess.TimeoutExpired):
                    self._process.wait(CLOSE_SECONDS)
        finally:
            self._kill()

    @classmethod
    def forget_all(cls) -> None:
        """Disown all workers; called in a fork, since workers belong to the parent."""
        for worker in tuple(cls._all):
            worker._forget()
        cls._all.clear()

    def _exchange(
        self, request: Mapping[str, Any], time_limit: float, memory_limit: float
    ) -> tuple[dict[str, Any], float | None]:
        """Send a request; return the answer, and the time to the event "timed"."""
        with suppress(OSError):
            self._log.write_bytes(b"")
        sent, elapsed = time.monotonic(), None
        self._send(request)
        is_shared, is_timed = "case" in request, "out" in request
        events = [
            *[("built", time_limit)] * is_shared,
            ("start", START_SECONDS),
            *[("solved", time_limit), ("timed", REPEAT_SECONDS)] * is_timed,
            *[("measured", POINT_SECONDS)] * (is_shared and is_timed),
        ]
        try:
            for event, limit in events:
                entries = self._await(event, limit, memory_limit)
                if event == "built":
                    self._built = entries
                elif event == "timed":
                    elapsed = time.monotonic() - sent
            limit = max(time_limit, POINT_SECONDS) if is_timed else time_limit
            # the memory of the evaluation does not count
            answer = self._await("done", limit, None if is_shared else memory_limit)
        except _WorkerEndError as end:
            if is_shared:
                stages = {"built": "build: ", "done": "evaluation of the answer: "}
                end.stage = stages.get(end.event, "")
            raise
        self._trim_log()
        return answer, elapsed

    def _reply_to_end(self, end: _WorkerEndError, memory_limit: float) -> Reply:
        """Diagnose the end of a worker: a verdict on the solver, or a fault."""
        peak, verdict = self._peak_mib, end.verdict
        message = f"{end.stage}{'before solving: ' * end.is_early}{end.message}"
        if end.is_early and verdict is Verdict.TIME_LIMIT:
            # the limit `START_SECONDS` has expired, not the limit of the suite
            verdict = Verdict.FAILED
        from_outside = end.signal in _EXTERNAL_SIGNALS
        has_failed = from_outside or _MACHINE_FAILURE.search(message) is not None
        is_fault = end.is_fault or (end.is_early and has_failed)
        if out_of_memory(message, peak, memory_limit):
            verdict, is_fault = Verdict.MEMORY_LIMIT, False
        elif end.signal == "SIGKILL" and peak > limits.memory_limit_mib() / 2:
            # the kernel has killed it
            message = f"{message}: the machine ran out of memory"
            verdict, is_fault = Verdict.MEMORY_LIMIT, False
        return self._reply(
            verdict=None if is_fault else verdict,
            fault=is_fault,
            message=message,
            in_repeats=end.event == "timed",
        )

    def _reply(self, **entries: Any) -> Reply:
        peak = self._peak_mib or None
        return Reply(peak_mib=peak, built=self._built, **self._facts, **entries)

    def _start(self, memory_limit: float) -> None:
        """Start the worker and run its warm-up, unless it is warm already.

        A worker that dies during the warm-up is restarted without a warm-up.
        """
        while not self._is_warm:
            if self._process is None:
                self._spawn(memory_limit)
            self._await("ready", START_SECONDS, memory_limit)
            # if the worker has ended, the next event is not received
            with suppress(psutil.Error, IndexError):
                self._worker = psutil.Process(self._tree()[0])
            try:
                if self._warms_up:
                    self._send({"warm_up": True})
                    facts = self._await("warm", WARM_UP_SECONDS, memory_limit)
                    self._facts = {k: facts.get(k) for k in ("threads", "cpu")}
                self._is_warm = True
            except _WorkerEndError as end:
                if end.is_fault:
                    raise
                self._warms_up = False
                self._kill()

    def _spawn(self, memory_limit: float) -> None:
        """Start the command below a small parent."""
        requests, self._requests = os.pipe()
        self._replies, replies = os.pipe()
        cpu = fastest_first(os.sched_getaffinity(0))[0]
        above = (sys.executable, "-I", "-S", parent.__file__)
        arguments = (os.getpid(), cpu, requests, replies)
        limit = {limits.VARIABLE: str(memory_limit)}
        try:
            self._log.write_bytes(b"")
            # In append mode, the worker writes at the new end of the file after
            # `_trim_log`. Otherwise, a write at the old offset would restore the old
            # length of the file.
            with self._log.open("ab") as log:
                self._process = subprocess.Popen(
                    [*above, *map(str, arguments), *self._command],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    env=os.environ | limits.ONE_THREAD | limit,
                    pass_fds=(requests, replies),
                    start_new_session=True,
                )
        finally:
            os.close(requests)
            os.close(replies)

    def _send(self, request: Mapping[str, Any]) -> None:
        with suppress(BrokenPipeError):  # the worker has died; `_await` diagnoses why
            os.write(self._requests, (json.dumps(request) + "\n").encode())

    def _await(
        self, event: str, limit: float, memory_limit: float | None
    ) -> dict[str, Any]:
        """Wait for an event, and return its entries.

        limit : time limit, in s
        memory_limit : memory limit, in MiB; None if the memory is not recorded

        Raises
        ------
        _WorkerEndError
            If the worker ends, exceeds a limit, or sends a different reply.

        """
        ended = partial(_WorkerEndError, event)
        deadline = time.monotonic() + limit
        while b"\n" not in self._unread:
            # Check before reading: the reply of a worker that dies afterwards still
            # counts.
            is_dead = self._is_dead()
            chunk = self._read(0 if is_dead else POLL_SECONDS)
            self._unread += chunk
            if b"\n" in chunk:
                break
            if is_dead and not chunk:
                raise ended(Verdict.CRASHED, *self._death())
            if len(self._unread) > MAX_REPLY_BYTES:
                most = f"more than {MAX_REPLY_BYTES >> 20} MiB"
                raise ended(
                    Verdict.FAILED, f"{most} were received without an end of line"
                )
            if time.monotonic() > deadline:
                raise ended(Verdict.TIME_LIMIT, f"killed after {limit:g} s")
            if memory_limit is not None and (how := self._excess(memory_limit)):
                raise ended(Verdict.MEMORY_LIMIT, how)
            self._trim_log()
        line, _, self._unread = self._unread.partition(b"\n")
        try:
            reply = event_of(line, event)
        except ValueError as e:
            raise ended(Verdict.FAILED, str(e)) from None
        if reply.pop("event") == "fault":
            raise ended(Verdict.FAILED, reply["what"], is_fault=True)
        return reply

    def _excess(self, limit: float) -> str:
        """Record the memory of the worker; return a message if it exceeds the limit."""
        memory = _memory_mib(self._tree(), limit)
        self._peak_mib = max(self._peak_mib, memory)
        if memory <= limit:
            return ""
        return f"killed at {memory:.0f} MiB, above the limit of {limit:g} MiB"

    def _read(self, timeout: float) -> bytes:
        """Read replies of the worker, waiting at most `timeout` seconds."""
        if not select([self._replies], [], [], timeout)[0]:
            return b""
        chunk = os.read(self._replies, 2**16)
        # At end of file, the worker is dying, or its solver has closed all descriptors.
        if not chunk:
            time.sleep(timeout)
        return chunk

    def _trim_log(self) -> None:
        with suppress(OSError):  # other code reports a deleted folder
            if self._log.stat().st_size > LOG_BYTES:
                os.truncate(self._log, 0)

    def _is_dead(self) -> bool:
        return self._process is None or self._process.poll() is not None

    def _tree(self) -> list[int]:
        """List the worker and its descendants; empty if the worker's parent has ended.

        psutil would read the status of every process of the machine.
        """
        if self._process is None or self._process.poll() is not None:
            return []
        return parent.descendants(self._process.pid)

    def _has_children(self) -> bool:
        """Return True if the worker has started processes that still exist."""
        for number in {*self._tree()} - {self._worker.pid}:
            with suppress(psutil.Error):
                if psutil.Process(number).status() != psutil.STATUS_ZOMBIE:
                    return True
        return False

    def _is_busy(self) -> bool:
        """Return True if threads of the idle worker continue to compute.

        Threads of pools may spin before they sleep, for at most `SETTLE_SECONDS`.
        """
        deadline = time.monotonic() + SETTLE_SECONDS
        with suppress(psutil.Error):
            while "running" in [
                psutil.Process(thread.id).status() for thread in self._worker.threads()
            ]:
                if time.monotonic() > deadline:
                    return True
                time.sleep(POLL_SECONDS / 40)
        return False

    def _death(self) -> tuple[str, str]:
        """Describe a worker's end; return also the signal that ended it, or "".

        The description includes the last line of the worker's output.
        """
        assert self._process is not None
        code, last = self._process.wait(), ""
        names = {-s.value: s.name for s in signal.Signals}
        name = names.get(code, f"signal {-code}") if code < 0 else ""
        how = name or f"exit code {code}"
        with suppress(OSError), self._log.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _LOG_TAIL_BYTES))
            text = file.read(_LOG_TAIL_BYTES).decode(errors="replace")
            last = text.strip().rpartition("\n")[2][-MAX_LAST_LINE_CHARACTERS:]
        return (f"{how}: {last}" if last else how), name

    def _kill(self) -> None:
        """Kill the worker and its descendants."""
        if self._process is not None:
            # a solver may have stopped the parent of its worker
            self._process.send_signal(signal.SIGCONT)
            self._process.terminate()
            try:
                self._process.wait(parent.END_SECONDS + 1.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._forget()

    def _forget(self) -> None:
        """Close the pipes, and forget the process and its state."""
        for fd in {self._requests, self._replies} - {-1}:
            os.close(fd)
        self._process = self._worker = None
        self._requests = self._replies = -1
        self._unread = b""
        self._is_warm = False


os.register_at_fork(after_in_child=WorkerProcess.forget_all)


@dataclass(eq=False)
class _WorkerEndError(Exception):
    """End of a worker before an expected event."""

    event: str  #: name of the expected event
    verdict: Verdict  #: verdict on the solver, if the solve had started
    message: str  #: description of the end
    signal: str = ""  #: name of the signal that ended the worker; else empty
    is_fault: bool = False  #: True if the worker reported a fault of the harness
    stage: str = ""  #: prefix of the message

    @property
    def is_early(self) -> bool:
        """True if the worker ended before it started to execute the request."""
        return self.event in ("ready", "warm", "start")


def _memory_mib(tree: list[int], limit: float) -> float:
    """Return the memory of a tree of processes, in MiB.

    The sum of resident sizes counts a shared page once per process. If the sum over
    several processes exceeds `limit`, in MiB, the proportional set sizes are added
    instead, for which the kernel has to walk all page tables.
    """
    resident = proportional = 0
    for number in tree:
        with suppress(psutil.Error):  # the process has ended
            resident += psutil.Process(number).memory_info().rss
    if resident <= limit * 2**20 or len(tree) == 1:
        return resident / 2**20
    for number in tree:
        with suppress(psutil.Error):
            proportional += psutil.Process(number).memory_full_info().pss
    return proportional / 2**20


_ALLOCATION_FAILURE = re.compile(
    r"MemoryError|bad_?alloc|out of memory|(un|can ?not |not )(able to )?allocate"
    r"|memory allocation|allocation (error|fail)",
    re.IGNORECASE,
)


def out_of_memory(message: str, peak_mib: float | None, limit: float) -> bool:
    """Return True if a failure is attributed to lack of memory.

    A solver that lacks memory may raise an exception, abort, crash, hang or return a
    wrong result. The failure is attributed to lack of memory if the peak memory was
    close to the limit or, since a single allocation may have been refused, if the
    message reports a failed allocation.

    message : message of the failure, including the last line of output
    peak_mib : peak memory, in MiB; None if unknown
    limit : memory limit, in MiB
    """
    near = peak_mib is not None and peak_mib >= MEMORY_LIMIT_SHARE * limit
    return near or _ALLOCATION_FAILURE.search(message) is not None
