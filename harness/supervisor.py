"""The parent's side of a worker process: ask it, limit it, and tell how it died.

Only SIGKILL to the whole process group stops every solver: C code ignores alarms, and
some ignore SIGTERM. Memory is limited by looking at what is resident, since a limit on
address space counts what libraries reserve and never touch. Needs Linux's /proc.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from select import select
from typing import Any

from harness import limits
from harness.measure import memory_mib
from harness.record import Verdict

POLL_SECONDS = 0.02
START_SECONDS = 120.0  #: for imports, and for loading a QP
WARM_UP_SECONDS = 60.0
CLOSE_SECONDS = 1.0
LOG_BYTES = 2**20  #: what a solver may print before we drop it
LAST_WORDS = 300  #: characters of its last line that a message holds
NEAR = 0.9  #: of the memory limit: who fails beyond that failed for want of memory

_LIBRARIES = ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMEXPR", "RAYON")
ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in _LIBRARIES}


@dataclass(frozen=True, kw_only=True)
class Reply:
    """What came of a request: the worker's own answer, or how the worker ended."""

    answer: Mapping[str, Any] | None = None
    verdict: Verdict | None = None  #: None where there is an answer
    message: str = ""
    peak_mib: float | None = None  #: largest resident memory seen from outside
    threads: int | None = None  #: of the worker, as it found by itself
    cpu: int | None = None


class WorkerProcess:
    """One worker, started when it is first asked, and anew after each death.

    `command` is what starts it, to which two file descriptors are appended: where it
    reads requests, where it replies. It runs in a process group of its own, on one
    CPU (the last one that we may use), with one thread in every library that obeys its
    environment variable. What it prints goes to the file `log`.
    """

    def __init__(self, command: list[str], log: Path) -> None:
        self._command = command
        self._log = log
        self._process: subprocess.Popen[bytes] | None = None
        self._requests = self._replies = -1  # our ends of the two pipes
        self._unread = b""
        self._warms_up = True
        self._facts: dict[str, Any] = {}  # what it told of its warm-up
        self._peak_mib = 0.0

    def ask(
        self, request: Mapping[str, Any], *, time_limit: float, memory_limit: float
    ) -> Reply:
        """Have one measurement made.

        time_limit : s, from the worker's "start" on: neither its imports nor its
            warm-up nor loading the QP count
        memory_limit : MiB, resident
        """
        self._peak_mib = 0.0
        try:
            if self._process is not None and self._is_dead():
                self._kill()  # since its last answer: no fault of this measurement
            if self._process is None:
                self._start(memory_limit)
            self._log.write_bytes(b"")
            self._send(request)
            self._await("start", START_SECONDS, memory_limit)
            answer = self._await("done", time_limit, memory_limit)
        except _EndedError as end:
            self._kill()
            verdict = end.verdict
            if out_of_memory(str(end), self._peak_mib, memory_limit):
                verdict = Verdict.MEMORY_LIMIT
            return Reply(
                verdict=verdict,
                message=str(end),
                peak_mib=self._peak_mib or None,
                **self._facts,
            )
        self._trim_log()
        if self._children():  # they would disturb the next measurement
            self._kill()
        return Reply(answer=answer, peak_mib=self._peak_mib or None, **self._facts)

    def close(self) -> None:
        """Let the worker end by itself, soon; its children end with it."""
        if self._process is None:
            return
        os.close(self._requests)
        self._requests = -1
        deadline = time.monotonic() + CLOSE_SECONDS
        while time.monotonic() < deadline and not self._is_dead():
            time.sleep(POLL_SECONDS / 4)
        self._kill()

    def _start(self, memory_limit: float) -> None:
        """Start and warm up; a solver that dies of the warm-up does without one."""
        self._spawn(memory_limit)
        if not self._warms_up:
            return
        try:
            self._send({"warm_up": True})
            told = self._await("warm", WARM_UP_SECONDS, memory_limit)
            cpus = told.get("cpus", ())
            self._facts = {
                "threads": told.get("threads"),
                "cpu": cpus[0] if len(cpus) == 1 else None,
            }
        except _EndedError:
            self._warms_up = False
            self._kill()
            self._spawn(memory_limit)

    def _spawn(self, memory_limit: float) -> None:
        their_requests, self._requests = os.pipe()
        self._replies, their_replies = os.pipe()
        self._unread = b""
        self._log.write_bytes(b"")
        with self._log.open("ab") as log:  # appending: it survives our truncating it
            self._process = subprocess.Popen(
                [*self._command, str(their_requests), str(their_replies)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=os.environ | ONE_THREAD | {limits.VARIABLE: str(memory_limit)},
                pass_fds=(their_requests, their_replies),
                start_new_session=True,
            )
        os.close(their_requests)
        os.close(their_replies)
        _pin(self._process.pid)
        self._await("ready", START_SECONDS, memory_limit)

    def _send(self, request: Mapping[str, Any]) -> None:
        with suppress(BrokenPipeError):  # it died; waiting for its reply tells how
            os.write(self._requests, (json.dumps(request) + "\n").encode())

    def _await(self, event: str, limit: float, memory_limit: float) -> dict[str, Any]:
        """Wait for an event; whatever else happens is raised as `_EndedError`."""
        deadline = time.monotonic() + limit
        while True:
            dead = self._is_dead()  # before reading: it may reply and then die
            self._read(0 if dead else POLL_SECONDS)
            while (reply := self._next_reply()) is not None:
                if reply["event"] == event:
                    return reply
            if dead:
                raise _EndedError(event, Verdict.CRASHED, self._death())
            if time.monotonic() > deadline:
                raise _EndedError(
                    event, Verdict.TIME_LIMIT, f"killed after {limit:g} s"
                )
            self._check_memory(event, memory_limit)
            self._trim_log()

    def _trim_log(self) -> None:
        if self._log.stat().st_size > LOG_BYTES:
            os.truncate(self._log, 0)

    def _read(self, timeout: float) -> None:
        """Take in what the worker has replied, waiting at most `timeout` seconds."""
        if b"\n" in self._unread:  # two replies came at once
            return
        if not select([self._replies], [], [], timeout)[0]:
            return
        chunk = os.read(self._replies, 2**16)
        self._unread += chunk
        if not chunk:  # closed: the worker is dying, or its solver closed all it found
            time.sleep(timeout)

    def _next_reply(self) -> dict[str, Any] | None:
        line, newline, rest = self._unread.partition(b"\n")
        if not newline:
            return None
        self._unread = rest
        reply: dict[str, Any] = json.loads(line)
        return reply

    def _check_memory(self, event: str, limit: float) -> None:
        family = (self._pid, *self._children())
        resident = sum(memory_mib("VmRSS", process) or 0.0 for process in family)
        self._peak_mib = max(self._peak_mib, resident)
        if resident > limit:
            how = f"killed at {resident:.0f} MiB, above the limit of {limit:g} MiB"
            raise _EndedError(event, Verdict.MEMORY_LIMIT, how)

    def _children(self) -> list[int]:
        """List the processes that the worker started, and those that these started."""
        found, unseen = [], [self._pid]
        while unseen:
            for task in Path(f"/proc/{unseen.pop()}/task").glob("*/children"):
                with suppress(OSError):  # it may have ended
                    children = list(map(int, task.read_bytes().split()))
                    found += children
                    unseen += children
        return found

    @property
    def _pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def _is_dead(self) -> bool:
        """Look without reaping: until then nobody else can get its process group."""
        look = os.WEXITED | os.WNOHANG | os.WNOWAIT
        return os.waitid(os.P_PID, self._pid, look) is not None

    def _death(self) -> str:
        """How a dead worker ended, and its last words."""
        end = os.waitid(os.P_PID, self._pid, os.WEXITED | os.WNOWAIT)
        assert end is not None
        if end.si_code == os.CLD_EXITED:
            how = f"exit code {end.si_status}"
        else:
            names = {s.value: s.name for s in signal.Signals}
            how = names.get(end.si_status, f"signal {end.si_status}")
        last = (
            self._log.read_text(errors="replace")
            .strip()
            .rpartition("\n")[2][-LAST_WORDS:]
        )
        return f"{how}: {last}" if last else how

    def _kill(self) -> None:
        if self._process is None:
            return
        with suppress(ProcessLookupError):
            os.killpg(self._pid, signal.SIGKILL)
        self._process.wait()
        self._process = None
        os.close(self._replies)
        if self._requests != -1:
            os.close(self._requests)


class _EndedError(Exception):
    """A worker that did not come to the event we waited for."""

    def __init__(self, event: str, verdict: Verdict, how: str) -> None:
        super().__init__(how if event == "done" else f"before solving: {how}")
        self.verdict = verdict if event == "done" else _BEFORE.get(verdict, verdict)


_EXHAUSTION = re.compile(
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
    near = peak_mib is not None and peak_mib >= NEAR * limit
    return near or _EXHAUSTION.search(message) is not None


#: running out of time before the clock started is no fault of the solver's speed
_BEFORE = {Verdict.TIME_LIMIT: Verdict.FAILED}


def _pin(process: int) -> None:
    """Bind a process to the last CPU that we may use ourselves."""
    with suppress(ProcessLookupError):
        os.sched_setaffinity(process, {max(os.sched_getaffinity(0))})
