"""Sub-reaper: a parent of a worker, which ends all processes that the worker started.

Run as ``reaper.py CPU REQUESTS REPLIES COMMAND…``, the script starts COMMAND in a new
session, bound to one CPU, and exits with the same code or signal. The script is run by
an interpreter without site packages, which starts faster, since every worker has a
sub-reaper. A *sub-reaper* adopts each descendant whose parent ends, see prctl(2), so
that neither a double fork nor setsid(2) removes a process from the tree. The tree is
killed

* when COMMAND ends, and
* when the other end of the sub-reaper's standard input is closed, either by the process
  that started it or, if that process dies, by the kernel.

System V segments of shared memory that COMMAND created are also removed, because they
persist after all processes have ended.

Run as ``reaper.py rank RECORD COMMAND…``, the script is the parent of one MPI rank: it
starts COMMAND, writes the process ID and later the wait status of COMMAND to the file
descriptor RECORD, and exits with the same code or signal. Until its exit, the script
keeps the inherited descriptors open, so that mpiexec does not end the other ranks
before the record is written.

The process of the run is not a sub-reaper itself, for three reasons. If the process of
the run were killed, it could not clean up. The trees of two workers would be
indistinguishable. In a Python session that imports this package, a sub-reaper would
adopt unrelated processes.
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

TYPE_CHECKING = False  # importing typing (or json) would take 10 ms in each worker
if TYPE_CHECKING:
    from typing import NoReturn

#: list of the System V segments of shared memory, see proc(5)
SEGMENTS = "/proc/sysvipc/shm"
END_SECONDS = 5.0  #: longest time to wait for the end of processes after SIGKILL, s

_PR_SET_CHILD_SUBREAPER = 36  # constant of prctl(2)
_PR_SET_PDEATHSIG = 1
_IPC_RMID = 0  # constant of shmctl(2)
#: environment variables that contain the rank: MPICH, Open MPI, PMIx
_RANKS = ("PMI_RANK", "OMPI_COMM_WORLD_RANK", "PMIX_RANK")
_NOT_STARTED = 127  #: exit code of shells for a command that is not found


def descendants(root: int) -> list[int]:
    """List the process IDs of all descendants of `root` that are not zombies."""
    processes: list[int] = []
    unseen = [root]
    while unseen:
        process = unseen.pop()
        with suppress(OSError):  # the process, or a thread of it, may have ended
            # /proc lists children under the thread that forked them
            for task in os.listdir(f"/proc/{process}/task"):
                with (
                    suppress(OSError),
                    open(f"/proc/{process}/task/{task}/children", "rb") as file,
                ):
                    children = list(map(int, file.read().split()))
                    unseen += children
                    processes += children
    return [process for process in processes if is_alive(process)]


def _is_below(process: int, root: int) -> bool:
    """Return True if /proc lists a process as `root` or one of its descendants."""
    while process > 0 and process != root:
        process = int(_status(process, 1) or 0)
    return process == root > 0


def is_alive(process: int) -> bool:
    """Return True if the process exists and is not a zombie."""
    return state(process) not in ("", "Z", "X")


def state(process: int, task: int | None = None) -> str:
    """Return the state of a process or thread, a letter of proc(5), or "" if ended."""
    where = str(process) if task is None else f"{process}/task/{task}"
    return _status(where, 0)


def _status(where: int | str, field: int) -> str:
    """Return a field of /proc/WHERE/stat, or "" if the process has ended.

    field : index of the field, 0 for the first one after the name of the program
    """
    try:
        with open(f"/proc/{where}/stat", "rb") as file:
            # the last ")" ends the name, which may contain spaces and parentheses
            return file.read().rpartition(b")")[2].split()[field].decode()
    except (OSError, IndexError):
        return ""


def kill_descendants(root: int) -> None:
    """Kill every process below `root`, and wait until they have ended.

    All processes are stopped before any process is killed, and the tree is listed again
    until no new process appears. A stopped process cannot fork. If processes were
    killed one by one, a process that forks quickly could escape. The wait takes at most
    `END_SECONDS`, since a process in uninterruptible sleep could prolong it. Every
    process is sent SIGKILL at least once, however slow the machine is.
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
            _reap()  # orphans became children of the sub-reaper
        # check after sending the signals, so that each signal is sent at least once
        if time.monotonic() > deadline:
            return
        time.sleep(0.001)


def _send(process: int, number: int, root: int) -> None:
    """Send a signal to a process below `root`, not to another one that reuses the ID.

    A pidfd always refers to the same process. If the process with this ID still belongs
    to the tree after the pidfd was opened, the pidfd refers to a process of the tree.

    process : process ID
    number : number of the signal
    """
    # the process has ended, or another user's process reuses its ID
    with suppress(OSError):
        fd = os.pidfd_open(process)
        try:
            if _is_below(process, root):
                signal.pidfd_send_signal(fd, number)
        finally:
            os.close(fd)


def shared_segments() -> dict[int, int]:
    """Map this user's System V segments to the process IDs of their creators."""
    creators = {}
    with suppress(OSError), open(SEGMENTS) as file:  # kernels may lack this file
        names = file.readline().split()
        for line in file:
            row = dict(zip(names, map(int, line.split()), strict=False))
            if row["cuid"] == os.getuid():
                creators[row["shmid"]] = row["cpid"]
    return creators


def _reap() -> dict[int, int]:
    """Reap the children that have ended; return their wait statuses by process ID."""
    statuses = {}
    with suppress(ChildProcessError):
        while (child := os.waitpid(-1, os.WNOHANG))[0]:
            statuses[child[0]] = child[1]
    return statuses


def main(arguments: list[str]) -> None:
    """Run the command, kill its descendants, and exit with its code or signal."""
    if arguments[0] == "rank":
        _stand_above_rank(int(arguments[1]), arguments[2:])
    cpu, requests, replies, *command = arguments
    begin = partial(_execute, [*command, requests, replies])
    supervise(begin, int(cpu), (int(requests), int(replies)))


def supervise(begin: Callable[[], None], cpu: int, pipes: tuple[int, int]) -> None:
    """Become the sub-reaper above a worker, and exit with the worker's code or signal.

    begin : main function of the worker, which is a fork of this process; must not
        return
    cpu : CPU to which the worker is bound
    pipes : file descriptors of the worker's pipes, closed in this process
    """
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    # SIGCHLD wakes the poll of `events` through a pipe. Without the pipe, a signal that
    # arrives just before the poll would be missed.
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
    # If this process kept the pipes open, the parent would not notice the worker's
    # death.
    for fd in pipes:
        os.close(fd)
    others = os.sched_getaffinity(0) - {cpu}
    if others:
        os.sched_setaffinity(0, others)  # leave the measured CPU to the worker
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
    # Zombies would otherwise accumulate in a container whose init process reaps none.
    _reap()
    # Remove only segments whose creator has ended. If a process with the ID of the
    # creator is alive, the ID was reused, and the segment may belong to this process.
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
    """Write a line of JSON by a single write(2); lines of ranks do not interleave."""
    line = ", ".join(f'"{name}": {value}' for name, value in what.items())
    with suppress(OSError):  # raised if the reader has ended
        os.write(record, f"{{{line}}}\n".encode())


def _fork_bound_to_parent() -> int:
    """Fork a child that is killed when this process ends; see `os.fork`."""
    parent = os.getpid()
    child = os.fork()
    if child == 0:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        # If the parent died before the call of prctl, no signal is sent.
        if os.getppid() != parent:
            os._exit(_NOT_STARTED)
    return child


def _execute(command: list[str]) -> NoReturn:
    # Python ignores these signals, and execve(2) would preserve this disposition.
    for number in (signal.SIGPIPE, signal.SIGXFSZ):
        signal.signal(number, signal.SIG_DFL)
    try:
        os.execvp(command[0], command)
    except OSError as e:
        os.write(2, f"{command[0]} cannot be started: {e.strerror}\n".encode())
        os._exit(_NOT_STARTED)


def _end_as(status: int | None) -> NoReturn:
    """End this process with the exit code or signal in a wait status; None means 0."""
    if status is None or os.WIFEXITED(status):
        os._exit(0 if status is None else os.WEXITSTATUS(status))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # no core file of this process
    with suppress(OSError):  # the handler of SIGKILL cannot be set
        signal.signal(os.WTERMSIG(status), signal.SIG_DFL)
    signal.raise_signal(os.WTERMSIG(status))
    os._exit(_NOT_STARTED)  # reached only if the signal does not end this process


if __name__ == "__main__":
    main(sys.argv[1:])
