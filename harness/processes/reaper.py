"""The process that a worker lives under, with all that it starts.

Run as a program (``reaper.py CPU REQUESTS REPLIES COMMAND…``, by an interpreter without
site packages, since every worker has one) it starts COMMAND, bound to one CPU, in a
session of its own, and ends as COMMAND ends, with the same exit code or signal. It is a
*sub-reaper*, see prctl(2): a process below it whose parent ends becomes its child, so
that no double fork and no setsid leaves its tree. The tree is killed

* when COMMAND ends, and
* when the other end of its standard input is closed: the process that started it does
  that, or is dead, even by SIGKILL.

A process of its own rather than the run itself is the sub-reaper, because it outlives a
run that is killed, tells the trees of two workers apart, and leaves a Python session
that uses us as a library as it is.
"""

from __future__ import annotations

import ctypes
import os
import resource
import select
import signal
import sys
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from functools import partial

MARK = "MORTARBENCH_TREE"  #: environment variable that names the tree to its processes
END_SECONDS = 5.0  #: within which processes that were sent SIGKILL are gone

PR_SET_CHILD_SUBREAPER = 36  # prctl(2)
_PR_SET_PDEATHSIG = 1
_NOT_STARTED = 127  #: exit code, as of a shell that finds no command


def descendants(root: int) -> list[int]:
    """List the processes below `root` that live: neither zombies nor dead."""
    found: list[int] = []
    unseen = [root]
    while unseen:
        process = unseen.pop()
        with suppress(OSError):  # it may have ended, or a thread of it
            for task in os.listdir(f"/proc/{process}/task"):
                with (
                    suppress(OSError),
                    open(f"/proc/{process}/task/{task}/children", "rb") as file,
                ):
                    children = list(map(int, file.read().split()))
                    unseen += children
                    found += children
    return [process for process in found if lives(process)]


def marked(mark: str) -> list[int]:
    """List the processes, wherever they are, that were started with that `MARK`."""
    wanted, found = f"{MARK}={mark}".encode(), []
    for name in os.listdir("/proc"):
        with suppress(OSError):  # ended meanwhile, or somebody else's
            if name.isdigit():
                with open(f"/proc/{name}/environ", "rb") as file:
                    data = file.read()
                if wanted in data and wanted in data.split(b"\0") and lives(int(name)):
                    found.append(int(name))
    return found


def lives(process: int) -> bool:
    """Whether there is such a process, and it is no zombie."""
    return state(process) not in ("", "Z", "X")


def state(process: int, task: int | None = None) -> str:
    """Give the letter of a process's or thread's state, see proc(5); "" for none."""
    path = (
        f"/proc/{process}/stat" if task is None else f"/proc/{process}/task/{task}/stat"
    )
    try:
        with open(path, "rb") as file:
            return file.read().rpartition(b")")[2].split()[0].decode()
    except OSError:
        return ""


def end_all(root: int, spared: Collection[int] = (), mark: str = "") -> None:
    """Kill every process below `root` but `spared`, and wait until they are gone.

    They are stopped first, until there are no new ones: what is stopped cannot fork,
    and killing one by one would let a process that forks faster escape. One that the
    kernel holds is waited for `END_SECONDS` at most; none is left without its signal,
    however slow the machine.

    mark : of the tree, to find those that are not below `root` any more
    """
    deadline = time.monotonic() + END_SECONDS
    while True:
        stopped: set[int] = set()
        while new := _found(root, mark) - stopped - set(spared):
            for process in new:
                _send(process, signal.SIGSTOP)
            stopped |= new
        if not stopped:
            return
        for process in stopped:
            _send(process, signal.SIGKILL)
        if root == os.getpid():
            _reap()
        if time.monotonic() > deadline:
            return
        time.sleep(0.001)


def _found(root: int, mark: str) -> set[int]:
    outside = set(marked(mark)) - {root, os.getpid()} if mark else set()
    return outside.union(descendants(root))


def _send(process: int, number: int) -> None:
    with suppress(ProcessLookupError, PermissionError):
        os.kill(process, number)


def _reap() -> dict[int, int]:
    """Take note of the children that ended: their wait statuses."""
    ended = {}
    with suppress(ChildProcessError):
        while (got := os.waitpid(-1, os.WNOHANG))[0]:
            ended[got[0]] = got[1]
    return ended


def main(arguments: list[str]) -> None:
    """Start the command, see that nothing is left of it, and end as it ended."""
    cpu, requests, replies, *command = arguments
    begin = partial(_execute, [*command, requests, replies])
    supervise(begin, int(cpu), (int(requests), int(replies)))


def supervise(begin: Callable[[], None], cpu: int, pipes: tuple[int, int]) -> None:
    """Be the sub-reaper above a worker; this process ends as the worker ends.

    begin : what the worker, a fork of this process, does; it does not return
    pipes : the worker's, which it has to itself
    """
    prctl = ctypes.CDLL(None).prctl
    prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    woken, wakes = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wakes)
    reaper = os.getpid()
    worker = os.fork()
    if worker == 0:
        prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != reaper:
            os._exit(_NOT_STARTED)
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.close(woken)
        os.close(wakes)
        _detach(cpu)
        begin()
    for fd in pipes:
        os.close(fd)
    others = os.sched_getaffinity(0) - {cpu}
    if others:
        os.sched_setaffinity(0, others)  # not in the way of what is measured
    events = select.poll()
    events.register(0, select.POLLIN)
    events.register(woken, select.POLLIN)
    status = None
    while status is None:
        if 0 in dict(events.poll()):
            break
        with suppress(BlockingIOError):
            os.read(woken, 4096)
        status = _reap().get(worker)
    end_all(reaper)
    _reap()  # or they stay in the table of processes where init collects nothing
    _end_as(status)


def _detach(cpu: int) -> None:
    os.setsid()
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.close(null)
    os.sched_setaffinity(0, {cpu})


def _execute(command: list[str]) -> None:
    for ignored in (signal.SIGPIPE, signal.SIGXFSZ):  # by this interpreter
        signal.signal(ignored, signal.SIG_DFL)
    try:
        os.execvp(command[0], command)
    except OSError as e:
        os.write(2, f"{command[0]} cannot be started: {e.strerror}\n".encode())
        os._exit(_NOT_STARTED)


def _end_as(status: int | None) -> None:
    """End as a wait status says; None: the parent wishes it."""
    if status is None or os.WIFEXITED(status):
        os._exit(0 if status is None else os.WEXITSTATUS(status))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with suppress(OSError):  # SIGKILL has no handler
        signal.signal(os.WTERMSIG(status), signal.SIG_DFL)
    os.kill(os.getpid(), os.WTERMSIG(status))


if __name__ == "__main__":
    main(sys.argv[1:])
