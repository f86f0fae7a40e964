"""Workers that are forked from the parent instead of started as new interpreters.

A fork saves about half a second of CPU time for loading numpy and scipy. Like a worker
started by its command, a forked worker runs below a sub-reaper
(`harness.processes.reaper`), in its own session, and on one CPU. Its only open files
are its log and its two pipes. A forked worker starts with a copy of the parent's
memory. It is therefore forked before the parent reads or builds any data, and only if
the parent has a single thread (`is_safe`).
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import BinaryIO

from mortarbench.harness.processes import reaper

#: reads requests from the first file descriptor and writes replies to the second
Serve = Callable[[int, int], None]

_POLL_SECONDS = 0.001
_ENDED = os.WEXITED | os.WNOHANG


def is_safe() -> bool:
    """Return True if this process has a single thread, so that it may fork.

    A lock held by another thread at the time of the fork would never be released in the
    child.
    """
    return len(os.listdir("/proc/self/task")) == 1


class Fork:
    """Handle of the sub-reaper above a forked worker, similar to `subprocess.Popen`."""

    def __init__(self, pid: int, stdin: BinaryIO) -> None:
        self.pid = pid
        # The kernel may reuse the ID of a reaped process, but not the pidfd.
        self._process_fd = os.pidfd_open(pid)
        #: pipe to the sub-reaper, which kills the tree if the pipe is closed
        self.stdin = stdin

    def wait(self, timeout: float | None = None) -> None:
        """Wait until the process has ended.

        Raises
        ------
        subprocess.TimeoutExpired
            If the process is still running after `timeout` seconds.

        """
        deadline = None if timeout is None else time.monotonic() + timeout
        with suppress(ChildProcessError):  # raised if the process was reaped already
            while os.waitid(os.P_PIDFD, self._process_fd, _ENDED) is None:
                if deadline is not None and time.monotonic() > deadline:
                    raise subprocess.TimeoutExpired("a fork", timeout or 0.0)
                time.sleep(_POLL_SECONDS)
        os.close(self._process_fd)

    def kill(self) -> None:
        """Send SIGKILL to the sub-reaper."""
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._process_fd, signal.SIGKILL)


def fork(
    serve: Serve,
    *,
    cpu: int,
    pipes: tuple[int, int],
    log: int,
    environment: Mapping[str, str],
) -> Fork:
    """Fork a worker; the caller must have checked `is_safe`.

    serve : main function of the worker, called with the two `pipes`
    cpu, pipes : see `reaper.supervise`
    log : file descriptor that receives the worker's standard output and error
    environment : environment variables to set in the worker
    """
    for stream in filter(None, (sys.stdout, sys.stderr)):
        stream.flush()  # otherwise the child would write a copy of the buffered output
    child_end, parent_end = os.pipe()
    pid = os.fork()
    if pid:
        os.close(child_end)
        return Fork(pid, os.fdopen(parent_end, "wb"))
    try:
        os.setsid()
        # The parent's handlers raise `TerminatedError`, which would unwind the copy of
        # the parent's stack in the fork.
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, signal.SIG_DFL)
        for fd, target in ((child_end, 0), (log, 1), (log, 2)):
            os.dup2(fd, target)
        # An inherited end of another worker's pipe would keep this other worker alive.
        for fd in map(int, os.listdir("/proc/self/fd")):
            if fd > 2 and fd not in pipes:
                with suppress(OSError):  # listdir has closed its own descriptor already
                    os.close(fd)
        os.environ.update(environment)
        reaper.supervise(partial(_serve, serve, pipes), cpu, pipes)
    finally:  # the fork must never return to the caller
        os._exit(1)


def _serve(serve: Serve, pipes: tuple[int, int]) -> None:
    code = 1
    try:
        serve(*pipes)
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        with suppress(Exception):
            sys.stdout.flush()
        os._exit(code)
