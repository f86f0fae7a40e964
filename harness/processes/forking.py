"""A worker that is a fork of the process that asks it, in place of a new interpreter.

To load numpy and scipy takes a process half a second of CPU time, and a fork has them
already. Like a worker that is started by its command it lives below a sub-reaper
(`harness.processes.reaper`), in a session of its own, on one CPU, and has no open files
but its log and its two pipes. It begins with a copy of our memory. So it is forked
before anything is read or built, and only where no other thread runs, see `is_safe`.
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

#: what a worker does with the two file descriptors of its requests and its replies
Serve = Callable[[int, int], None]

_POLL_SECONDS = 0.001
_ENDED = os.WEXITED | os.WNOHANG


def is_safe() -> bool:
    """Return True if this process has one thread, and so may fork.

    Locks that other threads hold would stay locked in the fork.
    """
    return len(os.listdir("/proc/self/task")) == 1


class Fork:
    """The sub-reaper above a forked worker: what is used of a `subprocess.Popen`."""

    def __init__(self, pid: int, stdin: BinaryIO) -> None:
        self.pid = pid
        self._process_fd = os.pidfd_open(
            pid
        )  # its number is another's once it is collected
        self.stdin = stdin  #: its tree is killed when this is closed, or we are dead

    def wait(self, timeout: float | None = None) -> None:
        """Wait until it has ended.

        Raises
        ------
        subprocess.TimeoutExpired
            When it has not after `timeout` seconds.

        """
        deadline = None if timeout is None else time.monotonic() + timeout
        with suppress(ChildProcessError):  # it was collected with its tree
            while os.waitid(os.P_PIDFD, self._process_fd, _ENDED) is None:
                if deadline is not None and time.monotonic() > deadline:
                    raise subprocess.TimeoutExpired("a fork", timeout or 0.0)
                time.sleep(_POLL_SECONDS)
        os.close(self._process_fd)

    def kill(self) -> None:
        """Send SIGKILL."""
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
    """Start a worker; the caller has seen that it `is_safe`.

    cpu, pipes : as of `reaper.supervise`; the pipes are those that `serve` is given
    log : a file descriptor, its standard output and error
    environment : variables that differ from ours
    """
    for stream in filter(None, (sys.stdout, sys.stderr)):
        stream.flush()  # or the fork would write it once more
    theirs, ours = os.pipe()
    pid = os.fork()
    if pid:
        os.close(theirs)
        return Fork(pid, os.fdopen(ours, "wb"))
    try:
        os.setsid()
        for number in (signal.SIGTERM, signal.SIGHUP):  # which may unwind the parent
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, signal.SIG_DFL)
        for fd, at in ((theirs, 0), (log, 1), (log, 2)):
            os.dup2(fd, at)
        for fd in map(int, os.listdir("/proc/self/fd")):
            if fd > 2 and fd not in pipes:
                with suppress(OSError):  # that of the list itself
                    os.close(fd)
        os.environ.update(environment)
        reaper.supervise(partial(_serve, serve, pipes), cpu, pipes)
    finally:  # whatever happens: only the parent goes back to where it came from
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
