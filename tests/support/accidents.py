"""Plug-in with solvers that disturb a run, and one that detects disturbances.

Most of the solvers solve `tiny` of adversaries.py correctly, but have side effects;
others do not return an answer. `witness` fails if a process of another solver runs
during its solve.

If the module is run as a program with the name of a solver and two file descriptors, it
acts as a worker.
"""

import mmap
import os
import signal
import stat
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import psutil

sys.path.insert(0, str(Path(__file__).parent))

from adversaries import PROBLEMS, Honest, at_the_row, unsolved

from mortarbench.harness.processes.cases import Cases
from mortarbench.harness.processes.parent import descendants
from mortarbench.harness.processes.worker import Worker, serve


def processes(of_run):
    """Yield the IDs of processes that a run has started, directly or indirectly.

    of_run : value of the variable WATCHED in their environment
    """
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            environment = (entry / "environ").read_bytes().split(b"\0")
            if f"WATCHED={of_run}".encode() in environment:
                yield int(entry.name)


def runs(process):
    with suppress(psutil.Error):
        return psutil.Process(process).status() == psutil.STATUS_RUNNING
    return False


class Witness(Honest):
    """Solver that fails if other processes of the run use a CPU for 0.1 s."""

    def act(self, qp):
        mine = {os.getppid(), *descendants(os.getppid())}
        for _ in range(10):  # parents of workers wake up for a moment every second
            awake = [
                process
                for process in processes(os.environ["WATCHED"])
                if process not in mine and runs(process)
            ]
            if not awake:
                return at_the_row(qp)
            time.sleep(0.01)
        raise RuntimeError(f"disturbed by {awake}")


def reply_pipe():
    """Yield the descriptors of the pipes to which this worker may write its replies."""
    for name in os.listdir("/proc/self/fd"):
        fd = int(name)
        try:
            flags = int(Path(f"/proc/self/fdinfo/{fd}").read_text().split()[3], 8)
            if fd > 2 and stat.S_ISFIFO(os.fstat(fd).st_mode) and flags & os.O_WRONLY:
                yield fd
        except OSError:
            pass


class WritesNoise(Honest):
    """Solver that writes to the file descriptor of the replies by mistake."""

    def act(self, qp):
        for fd in reply_pipe():
            os.write(fd, b"\xff\x00 no JSON \xfe\n")
        return at_the_row(qp)


class WritesEndlessly(Honest):
    """Solver that writes megabytes without an end of line."""

    def act(self, qp):
        (fd,) = reply_pipe()
        while True:
            os.write(fd, bytes(2**16))


class Daemon(Honest):
    """Solver that leaves a process in a new session, which uses CPU time."""

    def act(self, qp):
        if os.fork() == 0:
            os.setsid()
            if os.fork() == 0:
                while True:
                    pass
            os._exit(0)
        os.wait()
        return at_the_row(qp)


class ExecutedDaemon(Honest):
    """Solver that starts another program without inherited file descriptors."""

    def act(self, qp):
        code = "import os\nif os.fork() == 0:\n  os.setsid()\n  while True: pass"
        subprocess.run([sys.executable, "-c", code], check=True)
        return at_the_row(qp)


class ForkBomb(Honest):
    """Solver whose processes fork faster than they can be killed one by one."""

    def act(self, qp):
        if os.fork() == 0:
            os.setsid()
            while True:
                if os.fork():
                    os._exit(0)
        return at_the_row(qp)


class HangsWithADaemon(Daemon):
    def act(self, qp):
        super().act(qp)
        time.sleep(3600)


class Burns(Honest):
    """Solver that leaves a thread behind, which uses CPU time."""

    def act(self, qp):
        threading.Thread(target=self.burn, daemon=True).start()
        return at_the_row(qp)

    def burn(self):
        while True:
            pass


class Pools(Honest):
    """Solver that leaves a sleeping thread behind."""

    def act(self, qp):
        if threading.active_count() < 3:  # stacks of more threads exceed the limit
            threading.Thread(target=time.sleep, args=[3600], daemon=True).start()
        return replace(at_the_row(qp), counts={"process": os.getpid()})


class HoardsInShm(Honest):
    """Solver that maps 600 MiB of shared memory."""

    def act(self, qp):
        hoard = mmap.mmap(-1, 600 * 2**20)
        for _ in range(600):
            hoard.write(bytes(2**20))
        time.sleep(3600)


class SharesPages(Honest):
    """Solver whose four processes share 150 MiB, which must be counted once."""

    def act(self, qp):
        hoard = np.ones(150 * 2**17)
        children = []
        for _ in range(3):
            if (child := os.fork()) == 0:
                hoard.sum()
                time.sleep(3600)
            children.append(child)
        time.sleep(0.5)
        for child in children:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
        return at_the_row(qp)


class HoardsInADaemon(Honest):
    """Solver that uses 600 MiB in a process outside the session."""

    def act(self, qp):
        hoarded, tells = os.pipe()
        if os.fork() == 0:
            os.setsid()
            if os.fork() == 0:
                hoard = mmap.mmap(-1, 600 * 2**20)
                for _ in range(600):
                    hoard.write(bytes(2**20))
                os.write(tells, b"all")
                time.sleep(3600)
            os._exit(0)
        os.wait()
        os.read(hoarded, 3)
        time.sleep(3600)


def spin(seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pass


class PatchesTheClock(Honest):
    """Solver that works for 2 ms with a clock that adds 1 s per call, as in tests."""

    clock: ClassVar = iter(np.arange(1e6) + time.perf_counter())

    def act(self, qp):
        from mortarbench.harness.verify import measure

        measure.perf_counter = self.clock.__next__
        spin(0.002)
        return at_the_row(qp)


class OnAll(Honest):
    """Correct solver of the QPs of `tiny` with any multiple of the objective."""

    def prepare(self, qp, tol):
        if qp.h.size != 1 or qp.q.size != 2:  # the warm-up
            return super().prepare(qp, tol)
        return lambda: self.act(qp)

    def at_the_row(self, qp):
        """Return the point with x₁ = h: z = −(P x + q)₁ and z_box = −(P x + q)₂."""
        gradient = qp.P.diagonal() * np.array([qp.h[0], 0.0]) + qp.q
        return replace(
            at_the_row(qp), z=-gradient[:1], z_box=np.array([0.0, -gradient[1]])
        )


class DiesOnOthers(OnAll):
    """Solver whose process ends if the objective is not that of `tiny`."""

    def act(self, qp):
        if qp.q[0] != -4.0:
            os.kill(os.getpid(), signal.SIGSEGV)
        return self.at_the_row(qp)


class HangsOnOthers(OnAll):
    """Solver that hangs if the objective is not that of `tiny`."""

    def act(self, qp):
        if qp.q[0] != -4.0:
            time.sleep(3600)
        return self.at_the_row(qp)


class WorksInDeclines(Honest):
    """Solver that works for 20 ms in `declines`."""

    def declines(self, qp):
        if qp.q[0] == -4.0:
            spin(0.02)


class StopsItself(Honest):
    def act(self, qp):
        os.kill(os.getpid(), signal.SIGSTOP)


class KillsItself(Honest):
    """Solver that ends by SIGKILL after the supervisor has polled the memory."""

    def act(self, qp):
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGKILL)


class KilledOnceWarmingUp(Honest):
    """Solver that ends by SIGKILL in the first warm-up, after creating $KILLED."""

    def prepare(self, qp, tol):
        killed = Path(os.environ["KILLED"])
        if not killed.exists():
            killed.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().prepare(qp, tol)


class ClosesAll(Honest):
    def act(self, qp):
        os.closerange(3, 256)
        return at_the_row(qp)


SOLVERS = {
    name.lower(): kind()
    for name, kind in list(globals().items())
    if isinstance(kind, type)
    and issubclass(kind, Honest)
    and kind.__module__ == __name__
} | {"honest": Honest()}

if __name__ == "__main__":
    what, *pipes = sys.argv[1:]
    cases = Cases(PROBLEMS, unsolved)
    serve(Worker(solver=SOLVERS.get(what), cases=cases), *map(int, pipes))
