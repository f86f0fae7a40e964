"""The parent's side of a worker process: ask it, limit it, and tell how it died.

Only SIGKILL to all processes that it started stops every solver: C code ignores alarms,
and some ignore SIGTERM. A sub-reaper (`harness.processes.reaper`) above each worker
keeps them together. Memory is limited by looking at what is held, since a limit on
address space counts what libraries reserve and never touch. Needs Linux's /proc.

The times that a worker reports must agree with the clock of the parent and with the CPU
time that the kernel counts. While one worker is asked, those that share its CPU are
stopped by SIGSTOP: nothing that a solver leaves running in its process disturbs
another's measurement. So threads of one process ask in turn. Signals go to file
descriptors of processes, see pidfd_open(2), and never to numbers, which the kernel
gives to others.
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
from collections.abc import Hashable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path
from select import poll, select
from typing import Any, ClassVar
from weakref import WeakSet

from mortarbench.harness import limits
from mortarbench.harness.limits import ONE_THREAD
from mortarbench.harness.processes import reaper
from mortarbench.harness.processes.footprint import Footprint
from mortarbench.harness.processes.forking import Fork, Serve, fork, is_safe
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

POLL_SECONDS = 0.02
START_SECONDS = 120.0  #: for imports, and for loading a QP
WARM_UP_SECONDS = 60.0
POINT_SECONDS = 120.0  #: to write the point of an answer
CLOSE_SECONDS = 1.0
END_SECONDS = 1.0  #: for the sub-reaper to end when all below it are dead
SETTLE_SECONDS = 0.5  #: after an answer: threads of pools go to sleep within that
#: share of the time between answer and request that is too much CPU time
MAX_IDLE_CPU_SHARE = 0.5
MIN_BUSY_CPU_SECONDS = 0.01  #: CPU time between answer and request that is nothing
LOG_BYTES = 2**20  #: what a solver may print before we drop it
MAX_LAST_LINE_CHARACTERS = 300  #: characters of its last line that a message holds
_LOG_TAIL_BYTES = 2**16  #: of the log, among which its last line is looked for
_MIN_FD = 3  #: of a pipe: those below are the standard streams, even if closed
#: of the memory limit: who fails beyond that failed for want of memory
MEMORY_LIMIT_SHARE = 0.9

_LOCK = ForkSafeLock()  #: of the thread that starts, asks, stops or ends a worker

REPLACEMENT_NOTE = "the worker was busy while idle, and was replaced"

_CPUCLOCK_SCHED = 2  #: with a process number, names its clock; see clock_getcpuclockid
#: signals that solvers do not end by; before a solve, somebody else sent them
_EXTERNAL_SIGNALS = {
    signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT,
}  # fmt: skip
#: last words of a process that the machine let down before it solved anything
_MACHINE_FAILURE = re.compile(
    r"No space left on device|Disk quota exceeded|Too many open files"
    r"|Read-only file system|Input/output error|cannot be started"
)


@dataclass(frozen=True, kw_only=True)
class Clock:
    """Bounds of the time that a worker may report, in seconds."""

    least: float  #: CPU time that the kernel counted between "start" and "timed"
    seen: float  #: from "start" to "timed", as they were read
    most: float  #: from the request to "timed"


@dataclass(frozen=True, kw_only=True)
class Reply:
    """What came of a request: the worker's own answer, or how the worker ended."""

    answer: Mapping[str, Any] | None = None
    verdict: Verdict | None = None  #: None where there is an answer, or a fault
    fault: bool = False  #: ours or the machine's, which `message` tells
    message: str = ""
    peak_mib: float | None = None  #: most memory seen from outside
    clock: Clock | None = None  #: where a measurement was made
    threads: int | None = None  #: of the worker, as it found by itself
    cpu: int | None = None
    #: sizes, digest and seconds of the QP that ranks have emitted, as soon as they had
    emitted: Mapping[str, Any] | None = None


class WorkerProcess:
    """One worker, started when it is first asked, and anew after each death.

    `command` is what starts it, to which two file descriptors are appended: where it
    reads requests, where it replies. It runs in a session of its own, on one CPU (the
    last one that we may use), with one thread in every library that obeys its
    environment variable. What it prints goes to the file `log`.

    Threads of one process may have workers, or share one: each request waits until the
    one before is answered. What this process forks has none of its workers.
    """

    first_seconds: dict[Hashable, float]  #: for who asks: what took how long at first

    _all: ClassVar[WeakSet[WorkerProcess]] = WeakSet()

    def __init__(self, command: list[str], log: Path) -> None:
        self.first_seconds = {}
        self._command = command
        self._log = log
        self._process: subprocess.Popen[bytes] | Fork | None = None  # the sub-reaper
        self._worker = 0  # its child, once it is ready
        self._reaper_fd = self._worker_fd = -1  # file descriptors of both
        self._cpu = -1
        self._requests = self._replies = -1  # our ends of the two pipes
        self._unread = bytearray()
        self._warms_up = True
        self._is_warm = False
        self._is_stopped = self._was_busy = False
        self._idle_since: tuple[float, float] | None = None  # our clock, its CPU time
        self._facts: dict[str, Any] = {}  # what it told of its warm-up
        self._footprint = Footprint()
        self._peak_mib = 0.0
        self._emitted: dict[str, Any] | None = None  # what was told of the QP
        with _LOCK:
            self._all.add(self)

    @_LOCK
    def fork(self, serve: Serve) -> None:
        """Start at once, as a fork of this process that calls `serve`.

        It does what the command would do, and has loaded already what we have, see
        `harness.processes.forking`. Where that is not safe, or comes to nothing, the
        command starts the worker when it is asked; and always if it is to be replaced.
        """
        if not is_safe():
            return
        try:
            self._spawn(inf, serve)
        except (_WorkerEndError, OSError):
            self._kill()

    @_LOCK
    def ask(
        self, request: Mapping[str, Any], *, time_limit: float, memory_limit: float
    ) -> Reply:
        """Have one measurement made.

        What a solver does to its process before it is asked to solve is no fault of the
        solve: the request goes to a new process then, once.

        time_limit : s, from the worker's "start" on: neither its imports nor its
            warm-up nor loading the QP count. Where ranks emit the QP themselves, they
            have as long for that; and to evaluate the answer, but `POINT_SECONDS` at
            least
        memory_limit : MiB, of all its processes together
        """
        self._peak_mib, self._emitted = 0.0, None
        cpu = max(os.sched_getaffinity(0))
        for worker in [w for w in self._all if w is not self and w._cpu == cpu]:
            worker._stop()
        was_busy = self._resume()
        notes = [REPLACEMENT_NOTE] if was_busy else []
        while True:
            is_new = not self._is_warm
            try:
                if is_new:
                    self._start(memory_limit)
                    self._is_warm = True
                answer, clock = self._exchange(request, time_limit, memory_limit)
                break
            except _WorkerEndError as end:
                self._kill()
                if end.is_early and not is_new:
                    continue
                return self._reply_to_end(end, memory_limit)
            except OSError as e:  # no process, no pipe, no log: ours, or the machine's
                self._kill()
                return Reply(fault=True, message=one_line(e))
        peak = self._peak_mib or None
        facts = self._facts
        if self._others():  # they would disturb the next measurement
            self._kill()
        elif self._stays_busy():
            self._kill()
            notes.append(REPLACEMENT_NOTE)
        else:
            self._idle_since = (time.monotonic(), self._cpu_seconds())
        return Reply(
            answer=answer,
            message="; ".join(dict.fromkeys(notes)),
            clock=clock,
            peak_mib=peak,
            emitted=self._emitted,
            **facts,
        )

    @_LOCK
    def close(self) -> None:
        """Let the worker end by itself, soon; its children end with it."""
        try:
            self._resume()
            self._close("_requests")
            deadline = time.monotonic() + CLOSE_SECONDS
            while time.monotonic() < deadline and not self._is_dead():
                time.sleep(POLL_SECONDS / 4)
        finally:
            self._kill()

    @classmethod
    def forget_all(cls) -> None:
        """Leave all workers to the process that this one is a fork of."""
        for worker in tuple(cls._all):
            worker._disown()
        cls._all.clear()

    def _exchange(
        self, request: Mapping[str, Any], time_limit: float, memory_limit: float
    ) -> tuple[dict[str, Any], Clock | None]:
        with suppress(OSError):
            self._log.write_bytes(b"")
        asked = time.monotonic()
        self._send(request)
        is_shared = source_of(request).is_shared
        if is_shared:
            self._emitted = self._await(
                "emitted", time_limit, memory_limit, stage="emission: "
            )
        self._await("start", START_SECONDS, memory_limit)
        started, used = time.monotonic(), self._cpu_seconds()
        oom_kills = _oom_kills()
        try:
            clock = None
            if measures(request):
                self._await("timed", time_limit, memory_limit)
                ended = time.monotonic()
                clock = Clock(
                    least=min(self._cpu_seconds() - used, ended - started),
                    seen=ended - started,
                    most=ended - asked,
                )
                self._footprint.notice(self._tree())
                self._send({"go": True})
            if is_shared:
                self._await("measured", POINT_SECONDS, memory_limit)
                peak = self._peak_mib  # what evaluating takes is not limited
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
        return answer, clock

    def _reply_to_end(self, end: _WorkerEndError, memory_limit: float) -> Reply:
        """Tell a solver's end from one that the machine or somebody brought about."""
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
            is_fault = (peak or 0.0) < limits.memory_limit_mib() / 2
        return Reply(
            verdict=None if is_fault else verdict,
            fault=is_fault,
            message=message,
            peak_mib=peak,
            emitted=self._emitted,
            **self._facts,
        )

    def _start(self, memory_limit: float) -> None:
        """Start and warm up; a solver that dies of the warm-up does without one.

        Who is killed from outside meanwhile is warmed up once more.
        """
        if self._process is None:
            self._spawn(memory_limit)
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

    def _spawn(self, memory_limit: float, serve: Serve | None = None) -> None:
        """Start; `serve` is what a fork does, and without one, the command is run."""
        usable = os.sched_getaffinity(0)
        self._cpu = max(usable)
        self._footprint = Footprint()
        self._unread = bytearray()
        their_requests, self._requests = _pipe()
        self._replies, their_replies = _pipe()
        pipes = (their_requests, their_replies)
        environment = ONE_THREAD | {limits.VARIABLE: str(memory_limit)}
        try:
            self._log.write_bytes(b"")
            # appending: it survives our truncating it
            with self._log.open("ab") as log:
                if serve is not None:
                    self._process = fork(
                        serve, cpu=self._cpu, pipes=pipes, log=log.fileno(),
                        environment=environment,
                    )  # fmt: skip
                else:
                    self._process = subprocess.Popen(
                        [
                            sys.executable, "-I", "-S", reaper.__file__, str(self._cpu),
                            *map(str, pipes), *self._command,
                        ],
                        stdin=subprocess.PIPE,  # closed when we die: the tree dies, too
                        stdout=log,
                        stderr=log,
                        env=os.environ | environment,
                        pass_fds=pipes,
                        start_new_session=True,
                    )  # fmt: skip
        finally:
            os.close(their_requests)
            os.close(their_replies)
        self._reaper_fd = os.pidfd_open(self._process.pid)
        self._await("ready", START_SECONDS, memory_limit)
        for worker in self._tree()[:1]:  # what comes later is listed later
            self._worker_fd = os.pidfd_open(worker)
            if worker in self._tree():  # or its number could be another's by now
                self._worker = worker
        if not self._worker:
            raise OSError(f"nothing runs below process {self._process.pid}, says /proc")

    def _send(self, request: Mapping[str, Any]) -> None:
        with suppress(BrokenPipeError):  # it died; waiting for its reply tells how
            os.write(self._requests, (json.dumps(request) + "\n").encode())

    def _await(
        self, event: str, limit: float, memory_limit: float, *, stage: str = ""
    ) -> dict[str, Any]:
        """Wait for an event; whatever else happens is raised as `_WorkerEndError`.

        stage : of a measurement, which the error then begins with
        """

        def ended(verdict: Verdict, how: str, *more: int) -> _WorkerEndError:
            return _WorkerEndError(event, verdict, how, *more, stage=stage)

        deadline = time.monotonic() + limit
        while True:
            dead = self._is_dead()  # before reading: it may reply and then die
            has_more = self._read(0 if dead else POLL_SECONDS)
            line, newline, rest = self._unread.partition(b"\n")
            if newline:
                self._unread = rest
                break
            if len(self._unread) > MAX_REPLY_BYTES:
                how = (
                    f"more than {MAX_REPLY_BYTES >> 20} MiB came without an end of line"
                )
                raise ended(Verdict.FAILED, how)
            if dead and not has_more:
                raise ended(Verdict.CRASHED, *self._death())
            if time.monotonic() > deadline:
                raise ended(Verdict.TIME_LIMIT, f"killed after {limit:g} s")
            held = self._footprint.mib(self._tree(), memory_limit)
            self._peak_mib = max(self._peak_mib, held)
            if held > memory_limit:
                how = f"killed at {held:.0f} MiB, above the limit of {memory_limit:g}"
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
        with suppress(OSError):  # the folder is gone: whoever writes there will say so
            if self._log.stat().st_size > LOG_BYTES:
                os.truncate(self._log, 0)

    def _read(self, timeout: float) -> bool:
        """Take in what the worker has replied, waiting at most `timeout` seconds.

        Returns whether anything is there to be looked at.
        """
        if b"\n" in self._unread:  # two replies came at once
            return True
        has_more = False
        while select([self._replies], [], [], 0 if has_more else timeout)[0]:
            chunk = os.read(self._replies, 2**16)
            if not chunk:  # closed: the worker is dying, or its solver closed all
                time.sleep(timeout)
                break
            self._unread += chunk
            has_more = True
            if b"\n" in chunk or len(self._unread) > MAX_REPLY_BYTES:
                break
        return has_more

    def _tree(self) -> list[int]:
        """List the worker, what it has started, and what these have."""
        if self._process is None:
            return []
        found = reaper.descendants(self._process.pid)
        return [] if self._is_dead() else found  # of somebody who got its number

    def _others(self) -> list[int]:
        return [process for process in self._tree() if process != self._worker]

    def _cpu_seconds(self) -> float:
        """Give the CPU time of the worker, all its threads, as the kernel counts it."""
        with suppress(OSError):  # it may have ended
            return time.clock_gettime(~self._worker << 3 | _CPUCLOCK_SCHED)
        return 0.0

    def _stop(self) -> None:
        if self._process is None or self._is_stopped:
            return
        if self._others():
            self._kill()  # started since it answered
            return
        self._was_busy = self._was_busy or self._has_been_busy()
        self._signal(signal.SIGSTOP)
        self._is_stopped = True

    def _resume(self) -> bool:
        """Go on where `_stop` stopped; tell if the worker was busy while it was idle.

        Who was, and who has died meanwhile, is replaced when it is asked.
        """
        if self._process is None:
            return False
        if self._is_stopped:
            self._signal(signal.SIGCONT)
            self._is_stopped = False
        else:
            self._was_busy = self._has_been_busy()
        was_busy, self._was_busy = self._was_busy, False
        if was_busy or self._is_dead():
            self._kill()
        return was_busy

    def _signal(self, number: signal.Signals) -> None:
        """Send a signal to the worker, if it is there."""
        if self._worker_fd != -1:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._worker_fd, number)

    def _has_been_busy(self) -> bool:
        if self._idle_since is None:
            return False
        since, used = self._idle_since
        allowed = max(
            MIN_BUSY_CPU_SECONDS, MAX_IDLE_CPU_SHARE * (time.monotonic() - since)
        )
        return self._cpu_seconds() - used > allowed

    def _stays_busy(self) -> bool:
        """Whether threads of the worker run on although it has answered.

        Threads of pools spin for a while before they sleep. One that only waits for a
        CPU, on a machine that is not ours alone, uses none.
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
        """Look without collecting it; whoever does that, the descriptor stands for it.

        True where there is none.
        """
        if self._reaper_fd == -1:
            return True
        look = poll()
        look.register(self._reaper_fd)
        return bool(look.poll(0))

    def _death(self) -> tuple[str, int]:
        """How a dead worker ended, its last words included, and by which signal."""
        how, number = "ended, and other code of this process took its exit code", 0
        with suppress(ChildProcessError):
            how, number = _describe_exit(self._reaper_fd)
        last = ""
        with suppress(OSError), self._log.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _LOG_TAIL_BYTES))
            text = file.read(_LOG_TAIL_BYTES).decode(errors="replace")
            last = text.strip().rpartition("\n")[2][-MAX_LAST_LINE_CHARACTERS:]
        return (f"{how}: {last}" if last else how), number

    def _kill(self) -> None:
        """End all processes, and remove what they left in shared memory."""
        if self._process is not None:
            self._footprint.notice(self._tree())
            if not self._is_dead():
                reaper.kill_descendants(self._process.pid)
            if self._process.stdin is not None:
                self._process.stdin.close()  # the sub-reaper collects the dead and ends
            try:
                self._process.wait(END_SECONDS)
            except subprocess.TimeoutExpired:  # a solver has stopped it
                self._process.kill()
                self._process.wait()
            self._footprint.remove_shared()
        self._forget()

    def _disown(self) -> None:
        """Forget a worker of the process that this one is a fork of.

        An end of its pipes that stayed open here would keep it alive.
        """
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()
        self._forget()

    def _forget(self) -> None:
        self._process = None
        self._is_warm = False
        self._worker, self._is_stopped, self._was_busy = 0, False, False
        self._idle_since = None
        for name in ("_replies", "_requests", "_reaper_fd", "_worker_fd"):
            self._close(name)

    def _close(self, name: str) -> None:
        """Close a file descriptor once: its number may be another file's afterwards."""
        fd: int = getattr(self, name)
        setattr(self, name, -1)
        if fd != -1:
            os.close(fd)


os.register_at_fork(after_in_child=WorkerProcess.forget_all)


def _pipe() -> tuple[int, int]:
    """Open a pipe whose numbers a program can inherit beside its standard streams."""
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
    """Describe the end of a process, and return the signal that ended it; 0: none.

    process : a file descriptor, see pidfd_open(2)

    Raises
    ------
    ChildProcessError
        When it was collected, or is no child of this process.

    """
    end = os.waitid(os.P_PIDFD, process, os.WEXITED | os.WNOWAIT)
    assert end is not None
    if end.si_code == os.CLD_EXITED:
        return f"exit code {end.si_status}", 0
    names = {s.value: s.name for s in signal.Signals}
    return names.get(end.si_status, f"signal {end.si_status}"), end.si_status


class _WorkerEndError(Exception):
    """A worker that did not come to the event we waited for.

    event : that
    verdict : on the solver, if it was after the start
    number : of the signal that ended it, or 0
    stage : what the message begins with
    """

    def __init__(
        self, event: str, verdict: Verdict, how: str, number: int = 0, *, stage: str
    ) -> None:
        self.is_early = event not in ("emitted", "timed", "measured", "done")
        super().__init__(stage + (f"before solving: {how}" if self.is_early else how))
        if self.is_early and verdict is Verdict.TIME_LIMIT:
            verdict = Verdict.FAILED  # no fault of the solver's speed
        self.verdict = verdict
        self.signal = number
        self.is_fault = False  #: it says itself that our own code failed
        self.is_oom = False


def _facts(told: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a reply that a worker reports once, when it is warm."""
    cpus = told.get("cpus", ())
    return {
        "threads": told.get("threads"), "cpu": cpus[0] if len(cpus) == 1 else None
    }  # fmt: skip


def _oom_kills() -> int:
    """Count the processes that the kernel has killed for want of memory."""
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
    """Tell whether what failed did so for want of memory.

    Solvers answer exhaustion by an exception, an abort, a segmentation fault, a hang or
    a false result. What gives them away is their peak or, where a single allocation
    was refused, what the library says.

    message : of the failure, its last words included
    limit : MiB
    """
    near = peak_mib is not None and peak_mib >= MEMORY_LIMIT_SHARE * limit
    return near or _ALLOCATION_FAILURE.search(message) is not None
