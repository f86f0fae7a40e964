"""One machine of a cluster: what a Dask worker does for a run.

An `Executor` stays open in each Dask worker for as long as the run lasts; its solver
processes are on a CPU that no other of that machine has. It ends with the run.
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

from mortarbench.harness.environment.environment import capture_in, digest
from mortarbench.harness.errors import InputError
from mortarbench.harness.limits import ONE_THREAD
from mortarbench.harness.operators import Maker
from mortarbench.harness.registry import PluginFile, load_plugin, merged
from mortarbench.harness.results.work_unit import Commands, Outcome, WorkUnit
from mortarbench.harness.running.executor import Executor


@dataclass(frozen=True, eq=False, kw_only=True)
class Delivery:
    """Outcomes of a block, and where they were measured."""

    outcomes: list[Outcome]
    node: str  #: host name
    digest: str  #: of the environment
    environment: dict[str, Any]


@dataclass(eq=False)
class ExecutorPlugin(WorkerPlugin):
    """Opens an executor in every Dask worker, those that join later included.

    commands : of the parent; its Python is replaced by that of the node
    plugins : files, which must be there under the same paths
    operators : what puts an operator P together, less what is in `plugins`
    sharing : Dask workers on one machine; more than one disturb each other, which
        makes another environment
    packages : whose versions the environment of a node has
    """

    commands: Commands
    plugins: Sequence[PluginFile]
    operators: Mapping[str, Maker]
    sharing: int
    packages: Sequence[str]
    _python: str = sys.executable
    _open: _Open | None = None
    _ended: bool = False

    def setup(self, worker: Worker) -> None:
        """Open nothing yet: a block does, in the thread that it runs in.

        The kernel kills solver processes with the thread that started them.
        """
        self._worker = worker.id
        self._busy = Lock()

    def teardown(self, worker: Worker | None = None) -> None:
        """End the processes of the executor, at the latest when a measurement is made.

        Dask cannot stop a block that is being carried out; its thread comes here last.
        """
        self._ended = True
        if not self._busy.acquire(blocking=False):
            return
        if self._open is not None:
            self._open.stack.close()
            self._open = None
        self._busy.release()

    def execute(self, block: WorkUnit) -> Delivery:
        """Measure a block, or what can be measured of it before the run ends.

        Raises
        ------
        InputError
            When this machine is not fit to measure on.

        """
        try:
            with self._busy:
                return self._carried_out(block)
        finally:
            if self._ended:
                self.teardown()

    def _carried_out(self, block: WorkUnit) -> Delivery:
        opened = self._open = self._open or self._opened()
        os.sched_setaffinity(0, {opened.cpu.number})  # of this thread
        here = {"environment": opened.digest, "node": platform.node()}
        turns = tuple(tuple(r.replace(**here) for r in turn) for turn in block.turns)
        outcomes = []
        try:
            for outcome in opened.executor.execute(replace(block, turns=turns)):
                outcomes.append(outcome)
                if self._ended:
                    break
        except InputError as e:  # its disk is full
            raise InputError(f"{platform.node()}: {e}") from None
        return Delivery(
            outcomes=outcomes,
            node=platform.node(),
            digest=opened.digest,
            environment=opened.environment,
        )

    def _opened(self) -> _Open:
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
            return _Open(
                executor=executor,
                cpu=cpu,
                environment=environment,
                digest=digest(environment),
                stack=stack.pop_all(),
            )


def execute(name: str, block: WorkUnit) -> Delivery:
    """Measure a block by the node plug-in of that name; runs in a Dask worker.

    Raises
    ------
    InputError
        When this Dask worker is not fit to measure on.

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
class _Open:
    executor: Executor
    cpu: _Cpu
    environment: dict[str, Any]
    digest: str
    stack: ExitStack


class _Cpu:
    """A CPU that a Dask worker holds as long as one of its executors refers to it."""

    def __init__(self) -> None:
        stack = ExitStack()
        self.number = own_cpu(stack)
        finalize(self, stack.close)


#: by the Dask worker of this process
_held: WeakValueDictionary[str, _Cpu] = WeakValueDictionary()
_holding = Lock()


def _cpu_of(worker: str) -> _Cpu:
    """Hold a CPU for a Dask worker, which all its executors share.

    There are several where several runs measure there, or where one has died and its
    scheduler has not noticed yet. A Dask worker carries out one block at a time.

    Raises
    ------
    InputError
        As `own_cpu`.

    """
    with _holding:
        held = _held[worker] = _held.get(worker) or _Cpu()
    return held


def own_cpu(stack: ExitStack) -> int:
    """Take a CPU that no other executor on this machine has; the kernel gives it back.

    Raises
    ------
    InputError
        When there is none left, or somebody else has made the folder of the locks.

    """
    usable = sorted(os.sched_getaffinity(os.getpid()), reverse=True)
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
        "measure there already; start fewer"
    )


@contextmanager
def _lock_folder() -> Iterator[int]:
    """Open the folder of this user's locks, in that of everybody's temporary files.

    Raises
    ------
    InputError
        When what is there is a link or a file, is another user's, or open to others:
        they could plant links in it, or hold the locks.

    """
    path = Path(gettempdir()) / f"mortarbench-{os.getuid()}"
    with suppress(FileExistsError):
        path.mkdir(mode=0o700)
    wrong = InputError(
        f"{platform.node()}: {path} is not a folder of this user's alone; remove it, "
        "or set TMPDIR to another folder, the same for all Dask workers there"
    )
    try:
        fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        raise wrong from None
    try:
        found = os.fstat(fd)
        if found.st_uid != os.getuid() or stat.S_IMODE(found.st_mode) & 0o077:
            raise wrong
        yield fd
    finally:
        os.close(fd)
