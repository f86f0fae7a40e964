"""Small parent of a worker, which ends all processes that the worker started.

Run as ``parent.py RUN CPU REQUESTS REPLIES COMMAND…``, the script starts COMMAND in a
new session, bound to one CPU, and exits with the same code or signal. The file
descriptors REQUESTS and REPLIES are appended to COMMAND. The script is run by an
interpreter without site packages, which starts faster. As a *sub-reaper*, see prctl(2),
it adopts each descendant whose parent ends, so that neither a double fork nor setsid(2)
removes a process from the tree. The tree is killed when COMMAND ends, when the script
receives SIGTERM, and when the process RUN has ended.

Run as ``parent.py rank RECORD RANKS COMMAND…``, the script is the parent of one of
RANKS MPI ranks: it runs COMMAND, writes a line with the rank and its exit code or
signal to the file descriptor RECORD, and exits with the same code or signal.

The process of the run is not a sub-reaper itself: if it were killed, it could not clean
up, and in a Python session it would adopt unrelated processes.
"""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import sys
import time
from contextlib import suppress

END_SECONDS = 5.0  #: longest time to wait for the end of processes after SIGKILL, s
_WAKE_SECONDS = 1.0  # time between two checks that the process of the run exists
_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36  # constants of prctl(2)
_SIGNALS = (signal.SIGCHLD, signal.SIGTERM)
#: environment variables that contain the rank: MPICH, Open MPI, PMIx
_RANKS = ("PMI_RANK", "OMPI_COMM_WORLD_RANK", "PMIX_RANK")
_NOT_STARTED = 127  #: exit code of shells for a command that is not found


def descendants(root: int) -> list[int]:
    """List the process IDs of all descendants of `root`, parents before children."""
    found, unseen = list[int](), [root]
    while unseen:
        process = unseen.pop()
        with suppress(OSError):  # the process, or a thread of it, may have ended
            # /proc lists children under the thread that forked them
            for task in os.listdir(f"/proc/{process}/task"):
                with open(f"/proc/{process}/task/{task}/children", "rb") as file:
                    children = list(map(int, file.read().split()))
                found += children
                unseen += children
    return found


def main(arguments: list[str]) -> None:
    """Run the command, kill its descendants, and exit with its code or signal."""
    if arguments[0] == "rank":
        _record_rank(int(arguments[1]), arguments[2], arguments[3:])
    run, cpu, requests, replies, *command = arguments
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    worker = _start([*command, requests, replies], {int(cpu)})
    # If this process kept the pipes open, the run would not notice the worker's death.
    for fd in (requests, replies):
        os.close(int(fd))
    ended: dict[int, int] = {}
    while worker not in ended and os.getppid() == int(run):
        got = signal.sigtimedwait(_SIGNALS, _WAKE_SECONDS)
        if got is not None and got.si_signo == signal.SIGTERM:
            break
        ended |= _reap()
    deadline = time.monotonic() + END_SECONDS
    # A process may fork until it is killed, so list the tree again until it is empty.
    while (tree := descendants(os.getpid())) and time.monotonic() < deadline:
        for process in tree:
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        time.sleep(0.001)
        _reap()
    _end_as(ended.get(worker, 0))


def _record_rank(record: int, ranks: str, command: list[str]) -> None:
    rank = next((os.environ[name] for name in _RANKS if name in os.environ), "-1")
    status = os.waitpid(_start(command), 0)[1]
    code = os.waitstatus_to_exitcode(status)
    how = f"exit code {code}"
    if code < 0:
        how = f"{signal.strsignal(-code)} (signal {-code})"
    line = f"rank {rank} of {ranks} ranks ended: {how}"
    with suppress(BrokenPipeError):  # the reader ends after the first rank has ended
        os.write(record, f"{line}\n".encode())  # short lines do not interleave
    _end_as(status)


def _start(command: list[str], cpus: set[int] | None = None) -> int:
    """Start a command that is killed when this process ends; return its process ID.

    cpus : if not None, start the command in a new session, bound to these CPUs
    """
    parent, child = os.getpid(), os.fork()
    if child:
        return child
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if cpus is not None:
        os.setsid()
        os.sched_setaffinity(0, cpus)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    # Python ignores these signals, and execve(2) would preserve this disposition.
    for number in (signal.SIGPIPE, signal.SIGXFSZ):
        signal.signal(number, signal.SIG_DFL)
    try:
        # If the parent died before the call of prctl, no signal is sent.
        if os.getppid() == parent:
            os.execvp(command[0], command)
    except OSError as e:
        os.write(2, f"{command[0]} cannot be started: {e.strerror}\n".encode())
    os._exit(_NOT_STARTED)


def _reap() -> dict[int, int]:
    """Reap the children that have ended; return their wait statuses by process ID."""
    statuses = {}
    with suppress(ChildProcessError):
        while (child := os.waitpid(-1, os.WNOHANG))[0]:
            statuses[child[0]] = child[1]
    return statuses


def _end_as(status: int) -> None:
    """End this process with the exit code or signal in a wait status."""
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # no core file of this process
        with suppress(OSError):  # the handler of SIGKILL cannot be set
            signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
        signal.raise_signal(number)
    os._exit(os.waitstatus_to_exitcode(status))


if __name__ == "__main__":
    main(sys.argv[1:])
