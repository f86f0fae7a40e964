"""Dask plug-in that executes the blocks of a run on one machine of a cluster.

Each Dask worker keeps an `Executor` open for the duration of the run. The solver
processes of the executor are bound to a CPU that no other Dask worker on the machine
uses.
"""

from __future__ import annotations

import fcntl
import os
import platform
import stat
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from threading import Lock
from typing import Any, cast
from weakref import WeakValueDictionary, finalize

from distributed import Worker, get_worker
from distributed.diagnostics.plugin import WorkerPlugin

from mortarbench.harness.environment.cpus import fastest_first
from mortarbench.harness.environment.environment import capture_in, digest
from mortarbench.harness.errors import InputError
from mortarbench.harness.limits import ONE_THREAD
from mortarbench.harness.operators import Maker
from mortarbench.harness.registry import PluginFile, load_plugin, merged
from mortarbench.harness.results.work_unit import Commands, Outcome, WorkUnit
from mortarbench.harness.running.executor import Executor


@dataclass(frozen=True, eq=False, kw_only=True)
class Delivery:
    """Outcomes of a block, with the node and the environment of the measurements."""

    outcomes: list[Outcome]
    node: str  #: host name
    digest: str  #: digest of the environment
    environment: dict[str, Any]


@dataclass(eq=False)
class ExecutorPlugin(WorkerPlugin):
    """Plug-in with an executor in every Dask worker, including workers that join later.

    commands : commands of the parent, in which the Python interpreter of the node
        replaces the interpreter of the parent
    plugins : files that must exist under the same paths on the node
    operators : makers of operators P by name, except those of `plugins`
    sharing : largest number of Dask workers on one machine; the environment records
        this number, since several workers disturb each other's measurements
    packages : names of the packages whose versions an environment contains
    """

    commands: Commands
    plugins: Sequence[PluginFile]
    operators: Mapping[str, Maker]
    sharing: int
    packages: Sequence[str]
    _python: str = sys.executable
    _session: _Session | None = None
    _ended: bool = False

    def setup(self, worker: Worker) -> None:
        """Prepare the plug-in; the first block opens the executor.

        The thread that executes the blocks must open the executor, because the kernel
        kills solver processes when the thread that started them ends.
        """
        self._worker = worker.id
        self._busy = Lock()

    def teardown(self, worker: Worker | None = None) -> None:
        """End the executor's processes, at the latest after the current measurement.

        Dask cannot stop the execution of a block. If a block is being executed, its
        thread holds the lock and calls this method again after the current measurement.
        """
        self._ended = True
        if not self._busy.acquire(blocking=False):
            return
        if self._session is not None:
            self._session.stack.close()
            self._session = None
        self._busy.release()

    def execute(self, block: WorkUnit) -> Delivery:
        """Measure a block; stop after the current measurement if the run ends.

        Raises
        ------
        InputError
            If this machine is unsuitable for measurements, or its disk is full.

        """
        try:
            with self._busy:
                return self._carry_out(block)
        finally:
            if self._ended:
                self.teardown()

    def _carry_out(self, block: WorkUnit) -> Delivery:
        opened = self._session = self._session or self._open_session()
        os.sched_setaffinity(0, {opened.cpu.number})  # binds only this thread
        here = {"environment": opened.digest, "node": platform.node()}
        turns = tuple(tuple(r.replace(**here) for r in turn) for turn in block.turns)
        outcomes = []
        try:
            for outcome in opened.executor.execute(replace(block, turns=turns)):
                outcomes.append(outcome)
                if self._ended:
                    break
        except InputError as e:  # the disk of this machine is full
            raise InputError(f"{platform.node()}: {e}") from None
        return Delivery(
            outcomes=outcomes,
            node=platform.node(),
            digest=opened.digest,
            environment=opened.environment,
        )

    def _open_session(self) -> _Session:
        for file in self.plugins:
            if not file.path.is_file():
                raise InputError(
                    f"{platform.node()}: no plug-in {file.path}; "
                    "expected the same files under the same paths on every node"
                )
        environment = capture_in(ONE_THREAD, self.plugins, self.packages)
        if self.sharing > 1:
            environment["machine"]["shared_by_workers"] = self.sharing
        with ExitStack() as stack:
            cpu = _cpu_of(self._worker)
            folder = TemporaryDirectory(prefix="mortarbench-")
            scratch = Path(stack.enter_context(folder))
            operators: Mapping[str, Maker] = self.operators
            for file in self.plugins:
                operators = merged("operator", operators, load_plugin(file).operators)

            def here(command: list[str]) -> list[str]:
                return [sys.executable if w == self._python else w for w in command]

            commands = replace(
                self.commands,
                solvers={label: here(c) for label, c in self.commands.solvers.items()},
                case_worker=here(self.commands.case_worker),
            )
            executor = Executor(commands, scratch, scratch / "cases", operators)
            stack.callback(executor.close)
            return _Session(
                executor=executor,
                cpu=cpu,
                environment=environment,
                digest=digest(environment),
                stack=stack.pop_all(),
            )


def execute(name: str, block: WorkUnit) -> Delivery:
    """Measure a block with the plug-in `name`; called in a Dask worker.

    Raises
    ------
    InputError
        If this Dask worker executes several blocks at a time, or its machine is
        unsuitable for measurements.

    """
    worker = get_worker()
    if worker.state.nthreads != 1:
        raise InputError(
            f"the Dask worker {worker.name} on {platform.node()} takes "
            f"{worker.state.nthreads} blocks at a time, so that they would disturb "
            "each other; start it with --nthreads 1"
        )
    return cast(ExecutorPlugin, worker.plugins[name]).execute(block)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Session:
    executor: Executor
    cpu: _Cpu
    environment: dict[str, Any]
    digest: str
    stack: ExitStack


class _Cpu:
    """CPU that is reserved for a Dask worker as long as an executor refers to it."""

    def __init__(self) -> None:
        stack = ExitStack()
        self.number = claim_cpu(stack)
        finalize(self, stack.close)


#: reserved CPUs by the IDs of the Dask workers in this process
_cpus: WeakValueDictionary[str, _Cpu] = WeakValueDictionary()
_cpus_lock = Lock()


def _cpu_of(worker: str) -> _Cpu:
    """Reserve a CPU for a Dask worker; all executors in the worker share the CPU.

    A worker has several executors if several runs use it, or if the scheduler has not
    yet detected that the parent of an earlier run has died. In either case the worker
    executes one block at a time.

    Raises
    ------
    InputError
        If `claim_cpu` raises an InputError.

    """
    with _cpus_lock:
        cpu = _cpus[worker] = _cpus.get(worker) or _Cpu()
    return cpu


def claim_cpu(stack: ExitStack) -> int:
    """Reserve a CPU that no other Dask worker on this machine has reserved.

    The reservation is a file lock, which the kernel releases when the process ends.

    stack : stack whose closing releases the reservation

    Raises
    ------
    InputError
        If all CPUs are taken, or the folder of the locks is not safe to use.

    """
    usable = fastest_first(os.sched_getaffinity(os.getpid()))
    with _lock_folder() as folder:
        for cpu in usable:
            flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
            fd = os.open(f"cpu{cpu}.lock", flags, 0o600, dir_fd=folder)
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(fd)
                continue
            stack.callback(os.close, fd)
            return cpu
    raise InputError(
        f"{platform.node()} has {len(usable)} usable CPUs, and as many Dask workers "
        "use them already; start fewer workers"
    )


@contextmanager
def _lock_folder() -> Iterator[int]:
    """Open the folder of this user's locks, in the shared folder of temporary files.

    Raises
    ------
    InputError
        If the path is a link or a file, or if the folder belongs to another user or is
        accessible to other users, who could place links in it or lock its files.

    """
    path = Path(gettempdir()) / f"mortarbench-{os.getuid()}"
    with suppress(FileExistsError):
        path.mkdir(mode=0o700)
    wrong = InputError(
        f"{platform.node()}: {path} is not a folder that only this user can access; "
        "remove it, or set TMPDIR to the same other folder for all Dask workers there"
    )
    try:
        fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        raise wrong from None
    try:
        status = os.fstat(fd)
        if status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o077:
            raise wrong
        yield fd
    finally:
        os.close(fd)
