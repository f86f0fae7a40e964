"""Engine for several machines: the blocks of a run as tasks of Dask distributed.

Every Dask worker executes one block at a time, under the same supervision as in a run
on one machine. A task is one turn of a block: the measurement of one solver on one case
or on the steps of one sequence. The parent stores the records of a turn before it
submits the next turn. If a worker is lost, another worker measures the turns that the
lost worker did not return; if the lost worker had returned some turns, the records of
the others count as a separate block. Only the parent writes to the result folder.
"""

from __future__ import annotations

import logging
import os
import signal
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from multiprocessing import current_process, get_context, resource_tracker
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import current_thread, main_thread
from typing import TYPE_CHECKING, Any

from mortarbench.harness.environment.environment import packages_of
from mortarbench.harness.environment.labels import in_words
from mortarbench.harness.errors import InputError
from mortarbench.harness.operators import Maker
from mortarbench.harness.record import Record
from mortarbench.harness.registry import PluginFile
from mortarbench.harness.results.folder import differences
from mortarbench.harness.results.work_unit import (
    BuildFailure,
    Commands,
    Engine,
    EngineFactory,
    MeasurementFault,
    Outcome,
    Result,
    WorkUnit,
)

if TYPE_CHECKING:  # this module imports the optional package distributed
    from mortarbench.harness.running.dask_worker import Delivery

LOCAL = "local"
CONNECT_SECONDS = 10  #: time limit for connecting, and for fetching a finished result
#: longest time between two checks for workers that joined or were lost
CLUSTER_POLL_SECONDS = 2.0
MAX_LOST_WORKERS = 4  #: number of lost workers after which a block is given up
#: exit code of a process in which importing the main script starts a run
_UNGUARDED_SCRIPT_CODE = 75

Keep = Callable[[str, Mapping[str, Any]], None]  #: stores an environment by digest

#: keys of an environment in which all nodes must agree to run the same code
_CODE = ("source", "versions.mortarbench", "plugins")


@contextmanager
def on_cluster(
    address: str,
    *,
    plugins: Sequence[PluginFile],
    operators: Mapping[str, Maker],
    environment: Mapping[str, Any],
    keep: Keep,
    warn: Callable[[str], None],
) -> Iterator[EngineFactory]:
    """Connect to a Dask cluster, and provide a factory of engines on it.

    The connection is opened before a result folder is created, so that a wrong address
    leaves no folder.

    address : address of a scheduler, or "local" to start a scheduler with a worker for
        each CPU that this process may use
    plugins : files that must exist under the same paths on every node
    operators : makers of operators P by name, except those of `plugins`
    environment : environment of this process, with which nodes are compared
    keep : stores a node's environment under its digest
    warn : called with each message to the user, a single line

    Raises
    ------
    InputError
        If Dask is not installed, the scheduler does not answer, or the processes of a
        local cluster cannot import the main script. During the execution of blocks,
        also if a node is unsuitable or the scheduler is lost.

    """
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise InputError(
            "--dask needs the package distributed, which is not installed; "
            "pip install -c constraints.txt -e '.[cluster]'"
        ) from None

    with ExitStack() as stack:
        client = _connect(address, stack)

        @contextmanager
        def opened(commands: Commands, scratch: Path, cases: Path) -> Iterator[Engine]:
            from mortarbench.harness.running.dask_worker import ExecutorPlugin

            name = f"mortarbench-{client.id}"
            nodes = Nodes(environment, keep, warn)
            try:
                _end_orphaned_runs(client)
                files = [file.resolved() for file in plugins]
                workers = client.scheduler_info(n_workers=-1)["workers"].values()
                hosts = Counter(worker["host"] for worker in workers)
                sharing, packages = (
                    max(hosts.values(), default=1),
                    packages_of(environment),
                )
                node = ExecutorPlugin(
                    commands, files, dict(operators), sharing, packages
                )
                client.register_plugin(node, name=name)
                try:
                    yield _Cluster(client, name, nodes, address, warn)
                finally:
                    # End the processes of this run and of orphaned runs. The scheduler
                    # may end during the calls, as a local scheduler does on Ctrl-C
                    # (CommClosedError is an OSError), or may not have the plug-in yet
                    # (KeyError).
                    with suppress(OSError, KeyError):
                        if client.status == "running":
                            client.unregister_worker_plugin(name)
                            _end_orphaned_runs(client)
            except Exception as e:
                is_gone = isinstance(e, _SchedulerGoneError)
                is_gone = is_gone or client.status != "running"
                if isinstance(e, InputError) or not is_gone:
                    raise
                raise InputError(
                    f"the Dask scheduler at {address} is gone; start "
                    "a scheduler at this address, and repeat the command to continue"
                ) from e

        yield opened


@dataclass(eq=False)
class Nodes:
    """Environments of the machines that have returned measurements."""

    here: Mapping[str, Any]  #: environment of this process
    keep: Keep
    warn: Callable[[str], None]
    _stored: set[str] = field(default_factory=set)  # digests of stored environments

    def add(self, node: str, digest: str, environment: Mapping[str, Any]) -> None:
        """Store an environment if it is new, and warn if it differs from `here`.

        node : name of the machine, for messages
        digest : digest of `environment`

        Raises
        ------
        InputError
            If the node runs a different version of the code.

        """
        if digest in self._stored:
            return
        changed = list(differences(self.here, environment))
        for key, here, there in changed:
            if key.startswith(_CODE):
                what = in_words([(key, here, there)], "here", "there")
                raise InputError(
                    f"{node} runs different code from this machine ({what}); install "
                    "the same code on every node"
                )
        self._stored.add(digest)
        self.keep(digest, environment)
        if changed:
            what = in_words(changed, "here", "there")
            self.warn(
                f"{node} measures under different conditions from this machine "
                f"({what}); its times are marked as those of environment {digest}"
            )


@dataclass(eq=False, kw_only=True)
class _ActiveBlock:
    """Block in progress; if it has a worker, one of its turns is a Dask task."""

    block: WorkUnit
    turns_left: list[tuple[Record, ...]]  #: turns that no worker has returned yet
    worker: str = ""  #: address of the Dask worker that measures the block
    #: number of workers that were lost after they had returned some turns of the block
    part: int = 0
    is_measured: bool = False  #: True if the current worker has returned a turn
    lost_workers: int = 0  #: number of workers lost while they measured this block


@dataclass(eq=False)
class _Cluster:
    """Engine in which every Dask worker measures one block, one turn at a time.

    Each task is bound to the worker of its block. Otherwise, Dask would reassign the
    tasks of a lost worker, and turns measured on different machines would be compared
    as if they belonged to one block.
    """

    client: Any
    name: str  #: name of the plug-in of this run
    nodes: Nodes
    address: str
    warn: Callable[[str], None]
    _finished: SimpleQueue[Any] = field(default_factory=SimpleQueue)  # finished futures
    _active: dict[Any, _ActiveBlock] = field(default_factory=dict)  # blocks by future
    _queue: deque[_ActiveBlock] = field(default_factory=deque)

    def __call__(self, blocks: Iterator[WorkUnit]) -> Iterable[Outcome]:
        """Execute all blocks, and yield each outcome as soon as it is available."""
        try:
            while self._top_up(blocks):
                try:
                    yield from self._measured(
                        self._finished.get(timeout=CLUSTER_POLL_SECONDS)
                    )
                except Empty:
                    if self.client.status != "running":
                        raise _SchedulerGoneError from None
                    # A worker may be busy with a run whose parent has died. The
                    # scheduler detects the death of a parent only after a delay.
                    _end_orphaned_runs(self.client)
                yield from self._recovered()
        finally:
            for future in self._active:
                future.cancel()

    def _top_up(self, blocks: Iterator[WorkUnit]) -> bool:
        """Submit a block to every idle worker; return False if all blocks are done."""
        idle = self._workers() - {active.worker for active in self._active.values()}
        while idle or not self._active:
            if not self._queue and (block := next(blocks, None)) is not None:
                self._queue.append(
                    _ActiveBlock(block=block, turns_left=list(block.turns))
                )
            if not self._queue:
                return bool(self._active)
            if not idle:
                self.warn(f"waiting for Dask workers to join {self.address}")
                self.client.wait_for_workers(1)
                idle = self._workers()
            if idle:
                active = self._queue.popleft()
                active.worker = idle.pop()
                self._submit(active)
        return True

    def _workers(self) -> set[str]:
        """Return the addresses of the workers that are connected."""
        try:
            return set(self.client.nthreads())
        except OSError as e:
            raise _SchedulerGoneError from e

    def _submit(self, active: _ActiveBlock) -> None:
        """Submit the next turn of a block to its worker."""
        from mortarbench.harness.running.dask_worker import execute

        turn = replace(active.block, turns=(active.turns_left[0],))
        future = self.client.submit(
            execute, self.name, turn, workers=[active.worker], pure=False
        )
        self._active[future] = active
        future.add_done_callback(self._finished.put)

    def _measured(self, future: Any) -> Iterator[Outcome]:
        """Yield the outcomes of a finished turn; submit the next turn of its block."""
        from distributed import CancelledError

        # the worker of this block was lost
        if (active := self._active.get(future)) is None:
            return
        try:
            delivery: Delivery = future.result(timeout=CONNECT_SECONDS)
        except CancelledError as e:  # raised when the connection is lost
            raise _SchedulerGoneError from e
        except TimeoutError:  # the worker is lost, which `_recovered` will detect
            self._finished.put(future)
            return
        del self._active[future], active.turns_left[0]
        active.is_measured = True
        self.nodes.add(delivery.node, delivery.digest, delivery.environment)
        for outcome in delivery.outcomes:
            match outcome:
                case BuildFailure():
                    yield replace(outcome, block=active.block)
                    return
                case Result():
                    yield replace(outcome, part=active.part)
                case MeasurementFault():
                    yield outcome
        if active.turns_left:
            self._submit(active)

    def _recovered(self) -> Iterator[Outcome]:
        """Put the blocks of lost workers back into the queue.

        A block that has lost `MAX_LOST_WORKERS` workers is given up instead, and a
        failure is yielded for it.
        """
        workers = self._workers()
        lost = {f: b for f, b in self._active.items() if b.worker not in workers}
        for future, active in lost.items():
            del self._active[future]
            future.cancel()
            active.lost_workers += 1
            active.part += active.is_measured
            active.is_measured = False
            if active.lost_workers < MAX_LOST_WORKERS:
                self._queue.append(active)
            else:
                case = active.block.turns[0][0].case
                reason = (
                    f"{case} was given up: all Dask workers that executed it were lost"
                )
                yield BuildFailure(block=active.block, reason=reason)


class _SchedulerGoneError(Exception):
    pass


def _connect(address: str, stack: ExitStack) -> Any:
    """Connect to a scheduler, which is started first if the address is "local".

    stack : stack whose closing closes the connection and a local cluster

    Raises
    ------
    InputError
        If no scheduler answers.

    """
    from distributed import Client, LocalCluster

    # Dask would also log the errors that are reported here, with tracebacks.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    if address == LOCAL:
        with _delay_interrupt():
            _refuse_unguarded_script()
            cluster = LocalCluster(
                n_workers=len(os.sched_getaffinity(0)),
                threads_per_worker=1,
                memory_limit=0,  # the supervisor limits memory
                # use any free port, so that several clusters can coexist
                dashboard_address="127.0.0.1:0",
                scheduler_kwargs={"dashboard": False},
                silence_logs=logging.CRITICAL,
            )
            return stack.enter_context(Client(stack.enter_context(cluster)))
    try:
        return stack.enter_context(Client(address, timeout=CONNECT_SECONDS))
    # the library of each address scheme raises its own exceptions
    except Exception as e:
        if isinstance(e, TypeError) and address.startswith("tls:"):
            raise InputError(
                f"--dask {address}: Dask's configuration has no certificate for it; "
                "expected distributed.comm.tls: ca-file, client.cert and client.key, "
                "in a file or as DASK_DISTRIBUTED__COMM__TLS__CA_FILE in the "
                "environment"
            ) from e
        why = " ".join(str(e).split()) or type(e).__name__
        raise InputError(
            f"--dask {address}: no scheduler answers ({why}); expected 'local', or the "
            "address that `dask scheduler` prints, such as tcp://HOST:8786"
        ) from None


def _refuse_unguarded_script() -> None:
    """Check that an import of the main script does not start this run again.

    Each spawned Python process first imports the main script. One process is therefore
    spawned as a trial. If importing the script starts a run, this function is called in
    the trial process, which then exits with a special code.

    Raises
    ------
    InputError
        If importing the script starts a run, or fails.

    """
    if getattr(current_process(), "_inheriting", False):
        raise SystemExit(_UNGUARDED_SCRIPT_CODE)
    trial = get_context("spawn").Process(target=int)
    trial.start()
    trial.join()
    if trial.exitcode == _UNGUARDED_SCRIPT_CODE:
        raise InputError(
            "the processes of Dask import the main script, which starts this run "
            'again; move its statements below `if __name__ == "__main__":`'
        )
    if trial.exitcode:
        raise InputError(
            "the processes of Dask import the main script, and this import fails (exit "
            f"code {trial.exitcode})"
        )


@contextmanager
def _delay_interrupt() -> Iterator[None]:
    """Delay Ctrl-C to the end of the block, and shield processes started in the block.

    A terminal sends SIGINT to all processes of its group, and each Dask process would
    print a traceback. Dask processes inherit the signal mask of this thread, which
    blocks SIGINT; they end when this process closes the cluster. A second Ctrl-C is not
    delayed.
    """
    if current_thread() is not main_thread():  # Ctrl-C interrupts only the main thread
        yield
        return
    before = signal.getsignal(signal.SIGINT)
    received = []

    # The mask applies only to this thread. The kernel may deliver the signal to another
    # thread, and Python then runs the handler in the main thread.
    def delay(*_: object) -> None:
        received.append(signal.SIGINT)
        signal.signal(signal.SIGINT, before)

    # Start the resource tracker of multiprocessing now, since its start unblocks
    # SIGINT.
    resource_tracker.ensure_running()
    signal.signal(signal.SIGINT, delay)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, before)
    if received:
        raise KeyboardInterrupt


def _end_orphaned_runs(client: Any) -> None:
    """Unregister plug-ins of runs whose parent has died, which ends their processes."""

    # executed in the scheduler, where the connected clients are listed
    def orphaned(dask_scheduler: Any) -> list[str]:
        alive = {f"mortarbench-{client}" for client in dask_scheduler.clients}
        ours = (n for n in dask_scheduler.worker_plugins if n.startswith("mortarbench"))
        return [name for name in ours if name not in alive]

    for name in client.run_on_scheduler(orphaned):
        client.unregister_worker_plugin(name)
