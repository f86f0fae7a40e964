"""Supervision of a worker process: requests, limits and diagnosis of exits.

Only SIGKILL to all processes of a worker stops every solver, because Python handles an
alarm only after C code has returned, and some solvers ignore SIGTERM. A sub-reaper
(`harness.processes.reaper`) above each worker keeps these processes in one tree. Memory
is limited by polling the resident size, because RLIMIT_AS includes address space that
libraries reserve and never touch. The module requires the /proc file system of Linux.

All workers of a process share one CPU. Requests from several threads are therefore
serialised, and a worker that uses CPU time while it is idle is replaced, so that
running threads of one solver do not disturb the measurement of another solver.
"""

from __future__ import annotations

import fcntl
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
from math import inf
from pathlib import Path
from select import poll, select
from typing import Any, ClassVar
from weakref import WeakSet

import psutil

from mortarbench.harness import limits
from mortarbench.harness.environment.cpus import fastest_first
from mortarbench.harness.limits import ONE_THREAD
from mortarbench.harness.processes import reaper
from mortarbench.harness.processes.locks import ForkSafeLock
from mortarbench.harness.processes.protocol import (
    MAX_REPLY_BYTES,
    ForeignReplyError,
    event_of,
    measures,
    source_of,
)
from mortarbench.harness.record import Verdict
from mortarbench.harness.verify.measure import one_line

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
#: longest time between the end of all descendants of a sub-reaper and its own exit
END_SECONDS = 1.0
#: longest time for which idle threads of pools may spin after an answer
SETTLE_SECONDS = 0.5
#: CPU time of a worker between an answer and the next request, relative to wall time,
#: above which the worker counts as busy
MAX_IDLE_CPU_SHARE = 0.5
#: largest CPU time, in s, between an answer and the next request that does not count as
#: busy
MIN_BUSY_CPU_SECONDS = 0.01
LOG_BYTES = 2**20  #: size above which the log of a worker is truncated
#: length to which the last line of the log is shortened in a message
MAX_LAST_LINE_CHARACTERS = 300
_LOG_TAIL_BYTES = 2**16  #: bytes at the end of the log in which its last line is sought
_MIN_FD = 3  #: smallest descriptor of a pipe; smaller numbers are standard streams
#: fraction of the memory limit above which a failure is attributed to lack of memory
MEMORY_LIMIT_SHARE = 0.9

_LOCK = ForkSafeLock()  #: held while a thread starts, stops, ends or queries a worker

REPLACEMENT_NOTE = "the worker used CPU time between measurements, and was replaced"

_CPUCLOCK_SCHED = 2  #: bits of the ID of a CPU clock; see clock_getcpuclockid(3)
#: Signals that solvers do not send to themselves. If such a signal ends a worker before
#: a solve, the worker was killed from outside.
_EXTERNAL_SIGNALS = {
    signal.SIGKILL,
    signal.SIGTERM,
    signal.SIGINT,
    signal.SIGHUP,
    signal.SIGQUIT,
}
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
        self._process: subprocess.Popen[bytes] | None = None  # the sub-reaper
        self._worker = 0  # process ID of the worker, once it is ready
        self._reaper_fd = -1  # pidfd; -1 if there is no process
        # file descriptors of the two pipes in this process
        self._requests = self._replies = -1
        self._unread = bytearray()
        self._warms_up = True
        self._is_warm = False
        # True between the steps of a sequence that several processes solve
        self._keeps_ranks = False
        self._was_replaced = False  # True if the idle worker used CPU time
        # time on the parent's clock and CPU time of the worker at the last answer
        self._idle_since: tuple[float, float] | None = None
        # number of threads and CPU of the worker; see `_facts`
        self._facts: dict[str, Any] = {}
        self._peak_mib = 0.0
        self._built: dict[str, Any] | None = None  # entries of the event "built"
        with _LOCK:
            self._all.add(self)

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
        for worker in tuple(self._all):
            worker._end_if_busy()
        notes = [REPLACEMENT_NOTE] * self._was_replaced
        self._was_replaced = False
        while True:
            is_new = not self._is_warm
            try:
                if is_new:
                    self._start(memory_limit)
                    self._is_warm = True
                answer, elapsed = self._exchange(request, time_limit, memory_limit)
                break
            except _WorkerEndError as end:
                self._kill()
                if end.is_early and not is_new:
                    continue
                return self._reply_to_end(end, memory_limit)
            except OSError as e:  # a process, pipe or log could not be created
                self._kill()
                return Reply(fault=True, message=one_line(e))
        # copy these values, because `_kill` may reset them
        peak = self._peak_mib or None
        facts = self._facts
        self._keeps_ranks = "step" in request and source_of(request).is_shared
        if (
            self._others() and not self._keeps_ranks
        ):  # remaining processes would disturb the next measurement
            self._kill()
        elif self._stays_busy():
            self._kill()
            notes.append(REPLACEMENT_NOTE)
        else:
            self._idle_since = (time.monotonic(), self._cpu_seconds())
        return Reply(
            answer=answer,
            message="; ".join(dict.fromkeys(notes)),
            elapsed_seconds=elapsed,
            peak_mib=peak,
            built=self._built,
            **facts,
        )

    @_LOCK
    def close(self) -> None:
        """Close the pipe of requests; kill the worker if it does not exit in time.

        The time limit is `CLOSE_SECONDS`.
        """
        try:
            self._close("_requests")
            deadline = time.monotonic() + CLOSE_SECONDS
            while time.monotonic() < deadline and not self._is_dead():
                time.sleep(POLL_SECONDS / 4)
        finally:
            self._kill()

    @classmethod
    def forget_all(cls) -> None:
        """Disown all workers; called in a fork, since workers belong to the parent."""
        for worker in tuple(cls._all):
            worker._disown()
        cls._all.clear()

    def _exchange(
        self, request: Mapping[str, Any], time_limit: float, memory_limit: float
    ) -> tuple[dict[str, Any], float | None]:
        with suppress(OSError):
            self._log.write_bytes(b"")
        sent = time.monotonic()
        self._send(request)
        is_shared = source_of(request).is_shared
        if is_shared:
            self._built = self._await(
                "built", time_limit, memory_limit, stage="build: "
            )
        self._await("start", START_SECONDS, memory_limit)
        oom_kills = _oom_kills()
        try:
            elapsed = None
            if measures(request):
                self._await("solved", time_limit, memory_limit)
                self._await("timed", REPEAT_SECONDS, memory_limit)
                elapsed = time.monotonic() - sent
            if is_shared:
                self._await("measured", POINT_SECONDS, memory_limit)
                peak = self._peak_mib  # exclude the memory of the evaluation
                stage = "evaluation of the answer: "
                limit = max(time_limit, POINT_SECONDS)
                try:
                    answer = self._await("done", limit, inf, stage=stage)
                finally:
                    self._peak_mib = peak
            else:
                limit = POINT_SECONDS if measures(request) else time_limit
                answer = self._await("done", limit, memory_limit)
        except _WorkerEndError as end:
            end.is_oom = end.signal == signal.SIGKILL and _oom_kills() > oom_kills
            raise
        self._trim_log()
        return answer, elapsed

    def _reply_to_end(self, end: _WorkerEndError, memory_limit: float) -> Reply:
        """Diagnose the end of a worker: a verdict on the solver, or a fault."""
        peak, message, verdict = self._peak_mib or None, str(end), end.verdict
        is_fault = end.is_fault or (
            end.is_early
            and (
                end.signal in _EXTERNAL_SIGNALS
                or _MACHINE_FAILURE.search(message) is not None
            )
        )
        if out_of_memory(message, peak, memory_limit):
            verdict, is_fault = Verdict.MEMORY_LIMIT, False
        elif end.is_oom:
            message = f"{message}: the machine ran out of memory"
            verdict = Verdict.MEMORY_LIMIT
            # The process that the kernel kills need not be the cause. If the worker
            # used less than half of the available memory, the end counts as a fault.
            is_fault = (peak or 0.0) < limits.memory_limit_mib() / 2
        return Reply(
            verdict=None if is_fault else verdict,
            fault=is_fault,
            message=message,
            in_repeats=end.event == "timed",
            peak_mib=peak,
            built=self._built,
            **self._facts,
        )

    def _start(self, memory_limit: float) -> None:
        """Start the worker and run its warm-up.

        If the solver causes the worker's death during the warm-up, the worker is
        restarted without a warm-up. If the worker was killed from outside, the warm-up
        is repeated once.
        """
        if self._process is None:
            self._spawn(memory_limit)
        self._await_ready(memory_limit)
        for is_last in (False, True):
            if not self._warms_up:
                return
            try:
                self._send({"warm_up": True})
                self._facts = _facts(self._await("warm", WARM_UP_SECONDS, memory_limit))
                return
            except _WorkerEndError as end:
                if end.is_fault:
                    raise
                self._warms_up = end.signal in _EXTERNAL_SIGNALS and not is_last
                self._kill()
                self._spawn(memory_limit)
                self._await_ready(memory_limit)

    def _spawn(self, memory_limit: float) -> None:
        cpu = fastest_first(os.sched_getaffinity(0))[0]
        self._unread = bytearray()
        their_requests, self._requests = _pipe()
        self._replies, their_replies = _pipe()
        pipes = (their_requests, their_replies)
        environment = ONE_THREAD | {limits.VARIABLE: str(memory_limit)}
        try:
            self._log.write_bytes(b"")
            # In append mode, the worker writes at the new end of the file after
            # `_trim_log`. Otherwise, a write at the old offset would restore the old
            # length of the file.
            with self._log.open("ab") as log:
                self._process = subprocess.Popen(
                    [
                        sys.executable,
                        "-I",
                        "-S",
                        reaper.__file__,
                        str(cpu),
                        *map(str, pipes),
                        *self._command,
                    ],
                    # if this process dies, the kernel closes the pipe, which ends the
                    # tree
                    stdin=subprocess.PIPE,
                    stdout=log,
                    stderr=log,
                    env=os.environ | environment,
                    pass_fds=pipes,
                    start_new_session=True,
                )
        finally:
            os.close(their_requests)
            os.close(their_replies)
        self._reaper_fd = os.pidfd_open(self._process.pid)

    def _await_ready(self, memory_limit: float) -> None:
        assert self._process is not None
        self._await("ready", START_SECONDS, memory_limit)
        for worker in self._tree()[:1]:  # the tree lists a parent before its children
            self._worker = worker
        if not self._worker:
            raise OSError(f"/proc lists no process below {self._process.pid}")

    def _send(self, request: Mapping[str, Any]) -> None:
        with suppress(BrokenPipeError):  # the worker has died; `_await` diagnoses why
            os.write(self._requests, (json.dumps(request) + "\n").encode())

    def _await(
        self, event: str, limit: float, memory_limit: float, *, stage: str = ""
    ) -> dict[str, Any]:
        """Wait for an event, and return its entries.

        limit : time limit, in s
        memory_limit : memory limit, in MiB
        stage : stage of the measurement, as a prefix of the error message

        Raises
        ------
        _WorkerEndError
            If the worker ends, exceeds a limit, or sends a different reply.

        """

        def ended(verdict: Verdict, how: str, *more: int) -> _WorkerEndError:
            return _WorkerEndError(event, verdict, how, *more, stage=stage)

        deadline = time.monotonic() + limit
        while True:
            # Check before reading: the reply of a worker that dies afterwards still
            # counts.
            dead = self._is_dead()
            has_more = self._read(0 if dead else POLL_SECONDS)
            line, newline, rest = self._unread.partition(b"\n")
            if newline:
                self._unread = rest
                break
            if len(self._unread) > MAX_REPLY_BYTES:
                most = MAX_REPLY_BYTES >> 20
                how = f"more than {most} MiB were received without an end of line"
                raise ended(Verdict.FAILED, how)
            if dead and not has_more:
                raise ended(Verdict.CRASHED, *self._death())
            if time.monotonic() > deadline:
                raise ended(Verdict.TIME_LIMIT, f"killed after {limit:g} s")
            memory = _memory_mib(self._tree(), memory_limit)
            self._peak_mib = max(self._peak_mib, memory)
            if memory > memory_limit:
                how = f"killed at {memory:.0f} MiB, above the limit of {memory_limit:g}"
                raise ended(Verdict.MEMORY_LIMIT, f"{how} MiB")
            self._trim_log()
        try:
            reply = event_of(bytes(line), event)
        except ForeignReplyError as e:
            raise ended(Verdict.FAILED, str(e)) from None
        if reply.pop("event") == "fault":
            end = ended(Verdict.FAILED, one_line(reply["what"]))
            end.is_fault = True
            raise end
        return reply

    def _trim_log(self) -> None:
        with suppress(OSError):  # other code reports a deleted folder
            if self._log.stat().st_size > LOG_BYTES:
                os.truncate(self._log, 0)

    def _read(self, timeout: float) -> bool:
        """Read replies of the worker, waiting at most `timeout` seconds.

        Return True if a complete line is available, or new bytes were read.
        """
        if b"\n" in self._unread:  # a further reply was read together with the last one
            return True
        has_more = False
        while select([self._replies], [], [], 0 if has_more else timeout)[0]:
            chunk = os.read(self._replies, 2**16)
            # At end of file, the worker is dying, or its solver has closed all
            # descriptors.
            if not chunk:
                time.sleep(timeout)
                break
            self._unread += chunk
            has_more = True
            if b"\n" in chunk or len(self._unread) > MAX_REPLY_BYTES:
                break
        return has_more

    def _tree(self) -> list[int]:
        """List the worker and its descendants; empty if the sub-reaper has ended."""
        if self._process is None:
            return []
        processes = reaper.descendants(self._process.pid)
        # Check after the listing. If the sub-reaper has ended, another process may have
        # reused its ID, and the listed descendants may belong to this other process.
        return [] if self._is_dead() else processes

    def _others(self) -> list[int]:
        return [process for process in self._tree() if process != self._worker]

    def _cpu_seconds(self) -> float:
        """Return the CPU time, counted by the kernel, of all threads of the worker."""
        with suppress(OSError):  # the worker may have ended
            return time.clock_gettime(~self._worker << 3 | _CPUCLOCK_SCHED)
        return 0.0

    def _end_if_busy(self) -> None:
        """Kill the worker if it has died, or used CPU time since its last answer."""
        if self._process is not None and self._idle_since is not None:
            self._was_replaced |= self._has_been_busy()
            if self._was_replaced or self._is_dead():
                self._kill()

    def _has_been_busy(self) -> bool:
        assert self._idle_since is not None
        since, used = self._idle_since
        allowed = max(
            MIN_BUSY_CPU_SECONDS, MAX_IDLE_CPU_SHARE * (time.monotonic() - since)
        )
        return self._cpu_seconds() - used > allowed

    def _stays_busy(self) -> bool:
        """Return True if threads of the worker continue to compute after its answer.

        Threads of pools may spin before they sleep, for at most `SETTLE_SECONDS`. The
        decision depends on CPU time and not on the state "R", because on a busy machine
        a thread that waits for a CPU also has this state.
        """
        deadline = time.monotonic() + SETTLE_SECONDS
        pause, used = POLL_SECONDS / 100, self._cpu_seconds()
        while self._runs():
            if time.monotonic() > deadline:
                return self._cpu_seconds() - used > MIN_BUSY_CPU_SECONDS
            time.sleep(pause)
            pause = min(2 * pause, POLL_SECONDS)
        return False

    def _runs(self) -> bool:
        with suppress(OSError):
            tasks = os.listdir(f"/proc/{self._worker}/task")
            return any(reaper.state(self._worker, int(t)) == "R" for t in tasks)
        return False

    def _is_dead(self) -> bool:
        """Return True if the sub-reaper has ended, or was not started.

        A pidfd becomes and remains readable when its process ends, even if other code
        of this program reaps the process; waitpid(2) would then fail.
        """
        if self._reaper_fd == -1:
            return True
        poller = poll()
        poller.register(self._reaper_fd)
        return bool(poller.poll(0))

    def _death(self) -> tuple[str, int]:
        """Describe a worker's end; return also the signal that ended it, or 0.

        The description includes the last line of the worker's output.
        """
        how, number = (
            (
                "ended, but other code of this process reaped it, so that its "
                "exit code is unknown"
            ),
            0,
        )
        with suppress(ChildProcessError):
            how, number = _describe_exit(self._reaper_fd)
        last = ""
        with suppress(OSError), self._log.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _LOG_TAIL_BYTES))
            text = file.read(_LOG_TAIL_BYTES).decode(errors="replace")
            last = text.strip().rpartition("\n")[2][-MAX_LAST_LINE_CHARACTERS:]
        return (f"{how}: {last}" if last else how), number

    def _kill(self) -> None:
        """Kill the worker and its descendants."""
        if self._process is not None:
            if not self._is_dead():
                reaper.kill_descendants(self._process.pid)
            if self._process.stdin is not None:
                # the sub-reaper reaps its children and exits
                self._process.stdin.close()
            try:
                self._process.wait(END_SECONDS)
            # a solver may have sent SIGSTOP to the sub-reaper
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._forget()

    def _disown(self) -> None:
        """Close this fork's copies of a worker's file descriptors.

        The worker belongs to the parent of the fork. If a copy stayed open, the worker
        would survive the death of that parent.
        """
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()
        self._forget()

    def _forget(self) -> None:
        self._process = None
        self._is_warm = self._keeps_ranks = False
        self._worker, self._idle_since = 0, None
        for name in ("_replies", "_requests", "_reaper_fd"):
            self._close(name)

    def _close(self, name: str) -> None:
        """Close a file descriptor and forget it, since its number may be used again."""
        fd: int = getattr(self, name)
        setattr(self, name, -1)
        if fd != -1:
            os.close(fd)


os.register_at_fork(after_in_child=WorkerProcess.forget_all)


def _memory_mib(tree: list[int], limit: float) -> float:
    """Return the memory of a tree of processes, in MiB.

    The sum of resident sizes counts a shared page once per process. If the sum over
    several processes exceeds `limit`, in MiB, the proportional set sizes are added
    instead, for which the kernel has to walk all page tables.
    """
    processes = []
    for number in tree:
        with suppress(psutil.Error):
            processes.append(psutil.Process(number))
    total = 0
    for process in processes:
        with suppress(psutil.Error):
            total += process.memory_info().rss
    if total > limit * 2**20 and len(processes) > 1:
        total = 0
        for process in processes:
            with suppress(psutil.Error):
                total += process.memory_full_info().pss
    return total / 2**20


def _pipe() -> tuple[int, int]:
    """Open a pipe whose descriptors do not collide with the standard streams.

    If the calling program has closed a standard stream, pipe(2) may return the number
    of this stream, and the standard streams of the worker would replace the pipe.
    """
    ends = os.pipe()
    if min(ends) >= _MIN_FD:
        return ends
    try:
        read, write = (fcntl.fcntl(e, fcntl.F_DUPFD_CLOEXEC, _MIN_FD) for e in ends)
    finally:
        for end in ends:
            os.close(end)
    return read, write


def _describe_exit(process: int) -> tuple[str, int]:
    """Describe how a process ended; return also the signal that ended it, or 0.

    process : pidfd of the process

    Raises
    ------
    ChildProcessError
        If the process was reaped already, or is not a child of this process.

    """
    end = os.waitid(os.P_PIDFD, process, os.WEXITED | os.WNOWAIT)
    assert end is not None
    if end.si_code == os.CLD_EXITED:
        return f"exit code {end.si_status}", 0
    names = {s.value: s.name for s in signal.Signals}
    return names.get(end.si_status, f"signal {end.si_status}"), end.si_status


class _WorkerEndError(Exception):
    """End of a worker before an expected event.

    event : name of the expected event
    verdict : verdict on the solver, if the solve had started
    how : description of the end
    number : signal that ended the worker, or 0
    stage : prefix of the message
    """

    def __init__(
        self, event: str, verdict: Verdict, how: str, number: int = 0, *, stage: str
    ) -> None:
        self.event = event
        during = ("built", "solved", "timed", "measured", "done")
        self.is_early = event not in during
        super().__init__(stage + (f"before solving: {how}" if self.is_early else how))
        if self.is_early and verdict is Verdict.TIME_LIMIT:
            # the limit `START_SECONDS` has expired, not the limit of the suite
            verdict = Verdict.FAILED
        self.verdict = verdict
        self.signal = number
        self.is_fault = False  #: True if the worker reported a fault of the harness
        self.is_oom = False  #: True if the kernel killed the worker for lack of memory


def _facts(reply: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields that a worker reports once, after its warm-up."""
    cpus = reply.get("cpus", ())
    return {"threads": reply.get("threads"), "cpu": cpus[0] if len(cpus) == 1 else None}


def _oom_kills() -> int:
    """Return the number of processes that the kernel has killed for lack of memory."""
    with suppress(OSError), open("/proc/vmstat") as lines:
        for line in lines:
            if line.startswith("oom_kill "):
                return int(line.split()[1])
    return 0


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
