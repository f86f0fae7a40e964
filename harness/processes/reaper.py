"""The process that a worker lives under, with all that it starts.

Run as a program (``reaper.py CPU REQUESTS REPLIES COMMAND…``, by an interpreter without
site packages, since every worker has one) it starts COMMAND, bound to one CPU, in a
session of its own, and ends as COMMAND ends, with the same exit code or signal. It is a
*sub-reaper*, see prctl(2): a process below it whose parent ends becomes its child, so
that no double fork and no setsid leaves its tree. The tree is killed

* when COMMAND ends, and
* when the other end of its standard input is closed: the process that started it does
  that, or is dead, even by SIGKILL.

System V segments of shared memory that COMMAND has created are removed with it: they
outlive every process.

Run as ``reaper.py rank RECORD COMMAND…`` it stands above one rank of MPI: it starts
COMMAND, writes to the file descriptor RECORD which process that is and with which
status it ended, and ends alike. Until then it keeps open what COMMAND has inherited, so
that mpiexec ends no other rank before the record is written.

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
from collections.abc import Callable
from contextlib import suppress
from functools import partial

TYPE_CHECKING = False  # to load typing, or json, would take each worker 10 ms
if TYPE_CHECKING:
    from typing import NoReturn

SEGMENTS = "/proc/sysvipc/shm"  #: see proc(5)
END_SECONDS = 5.0  #: within which processes that were sent SIGKILL are gone

_PR_SET_CHILD_SUBREAPER = 36  # prctl(2)
_PR_SET_PDEATHSIG = 1
_IPC_RMID = 0  # shmctl(2)
_RANKS = ("PMI_RANK", "OMPI_COMM_WORLD_RANK", "PMIX_RANK")  #: variables, by MPI
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
    return [process for process in found if is_alive(process)]


def _is_below(process: int, root: int) -> bool:
    """Return True if a process descends from `root`, by the parents in /proc."""
    while process > 0 and process != root:
        process = int(_status(process, 1) or 0)
    return process == root > 0


def is_alive(process: int) -> bool:
    """Whether there is such a process, and it is no zombie."""
    return state(process) not in ("", "Z", "X")


def state(process: int, task: int | None = None) -> str:
    """Give the letter of a process's or thread's state, see proc(5); "" for none."""
    where = str(process) if task is None else f"{process}/task/{task}"
    return _status(where, 0)


def _status(where: int | str, field: int) -> str:
    """Read a field of /proc/WHERE/stat after the name; "" where there is none."""
    try:
        with open(f"/proc/{where}/stat", "rb") as file:
            return file.read().rpartition(b")")[2].split()[field].decode()
    except (OSError, IndexError):
        return ""


def kill_descendants(root: int) -> None:
    """Kill every process below `root`, and wait until they are gone.

    They are stopped first, until there are no new ones: what is stopped cannot fork,
    and killing one by one would let a process that forks faster escape. One that the
    kernel holds is waited for `END_SECONDS` at most; none is left without its signal,
    however slow the machine.
    """
    deadline = time.monotonic() + END_SECONDS
    while True:
        stopped: set[int] = set()
        while new := {*descendants(root)} - stopped:
            for process in new:
                _send(process, signal.SIGSTOP, root)
            stopped |= new
        if not stopped:
            return
        for process in stopped:
            _send(process, signal.SIGKILL, root)
        if root == os.getpid():
            _reap()
        if time.monotonic() > deadline:
            return
        time.sleep(0.001)


def _send(process: int, number: int, root: int) -> None:
    """Send a signal to a process of the tree, and to no other that got its number.

    The file descriptor stands for one process. Where that is in the tree after it was
    opened, it is the one that is meant.
    """
    with suppress(OSError):  # it has ended, or another user's program took its place
        opened = os.pidfd_open(process)
        try:
            if _is_below(process, root):
                signal.pidfd_send_signal(opened, number)
        finally:
            os.close(opened)


def shared_segments() -> dict[int, int]:
    """List this user's System V segments: number and creator."""
    found = {}
    with suppress(OSError), open(SEGMENTS) as file:  # a kernel without them
        names = file.readline().split()
        for line in file:
            row = dict(zip(names, map(int, line.split()), strict=False))
            if row["cuid"] == os.getuid():
                found[row["shmid"]] = row["cpid"]
    return found


def _reap() -> dict[int, int]:
    """Take note of the children that ended: their wait statuses."""
    ended = {}
    with suppress(ChildProcessError):
        while (got := os.waitpid(-1, os.WNOHANG))[0]:
            ended[got[0]] = got[1]
    return ended


def main(arguments: list[str]) -> None:
    """Start the command, see that nothing is left of it, and end as it ended."""
    if arguments[0] == "rank":
        _stand_above_rank(int(arguments[1]), arguments[2:])
    cpu, requests, replies, *command = arguments
    begin = partial(_execute, [*command, requests, replies])
    supervise(begin, int(cpu), (int(requests), int(replies)))


def supervise(begin: Callable[[], None], cpu: int, pipes: tuple[int, int]) -> None:
    """Be the sub-reaper above a worker; this process ends as the worker ends.

    begin : what the worker, a fork of this process, does; it does not return
    pipes : the worker's, which it has to itself
    """
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    woken, wakes = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wakes)
    reaper, before = os.getpid(), shared_segments().keys()
    worker = _fork_bound_to_parent()
    if worker == 0:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.close(woken)
        os.close(wakes)
        os.setsid()
        null = os.open(os.devnull, os.O_RDONLY)
        os.dup2(null, 0)
        os.close(null)
        os.sched_setaffinity(0, {cpu})
        begin()
    for fd in pipes:
        os.close(fd)
    others = os.sched_getaffinity(0) - {cpu}
    if others:
        os.sched_setaffinity(0, others)  # not in the way of what is measured
    events = select.poll()
    events.register(0, select.POLLIN)
    events.register(woken, select.POLLIN)
    ended: dict[int, int] = {}
    while worker not in ended:
        if 0 in dict(events.poll()):
            break
        with suppress(BlockingIOError):
            os.read(woken, 4096)
        ended |= _reap()
    status = ended.get(worker)
    creators = {worker, *ended, *_reap(), *descendants(reaper)}
    kill_descendants(reaper)
    _reap()  # or they stay in the table of processes where init collects nothing
    # System V segments of processes that have ended; a number that belongs to a living
    # process is not theirs any longer
    for segment, creator in shared_segments().items():
        if segment not in before and creator in creators and not is_alive(creator):
            ctypes.CDLL(None).shmctl(segment, _IPC_RMID, None)
    _end_as(status)


def _stand_above_rank(record: int, command: list[str]) -> NoReturn:
    rank = int(next((os.environ[name] for name in _RANKS if name in os.environ), -1))
    child = _fork_bound_to_parent()
    if child == 0:
        _execute(command)
    _write(record, rank=rank, process=child, above=os.getpid())
    status = os.waitpid(child, 0)[1]
    _write(record, rank=rank, status=status)
    _end_as(status)


def _write(record: int, **what: int) -> None:
    """Write one line of JSON at once, so that lines of several ranks do not mix."""
    line = ", ".join(f'"{name}": {value}' for name, value in what.items())
    with suppress(OSError):  # who reads them has ended
        os.write(record, f"{{{line}}}\n".encode())


def _fork_bound_to_parent() -> int:
    """Fork a process that is killed when this one ends; returns as `os.fork`."""
    parent = os.getpid()
    child = os.fork()
    if child == 0:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != parent:
            os._exit(_NOT_STARTED)
    return child


def _execute(command: list[str]) -> NoReturn:
    for ignored in (signal.SIGPIPE, signal.SIGXFSZ):  # by this interpreter
        signal.signal(ignored, signal.SIG_DFL)
    try:
        os.execvp(command[0], command)
    except OSError as e:
        os.write(2, f"{command[0]} cannot be started: {e.strerror}\n".encode())
        os._exit(_NOT_STARTED)


def _end_as(status: int | None) -> NoReturn:
    """End as a wait status says; None: the parent wishes it."""
    if status is None or os.WIFEXITED(status):
        os._exit(0 if status is None else os.WEXITSTATUS(status))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with suppress(OSError):  # SIGKILL has no handler
        signal.signal(os.WTERMSIG(status), signal.SIG_DFL)
    signal.raise_signal(os.WTERMSIG(status))
    os._exit(_NOT_STARTED)  # a signal that ends no process


if __name__ == "__main__":
    main(sys.argv[1:])
