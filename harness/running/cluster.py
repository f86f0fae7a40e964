"""More than one machine: the blocks of a run as tasks of Dask distributed.

Every Dask worker carries out one block at a time, with the supervisor that a run on one
machine uses. A task is one turn of a block: one solver, measured on one case, or on the
steps of one sequence. The parent writes its records before it submits the next turn.
What a worker that is lost has not returned is measured by another one, as a block of
its own. The parent alone writes the result folder.
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

if TYPE_CHECKING:  # it needs the package distributed
    from mortarbench.harness.running.dask_worker import Delivery

LOCAL = "local"
CONNECT_SECONDS = 10
CLUSTER_POLL_SECONDS = 2.0  #: for workers that joined or were lost
MAX_LOST_WORKERS = 4  #: workers that a block may cost
#: exit code of a process whose main script starts a run at its import
_UNGUARDED_SCRIPT_CODE = 75

Keep = Callable[[str, Mapping[str, Any]], None]

#: of an environment: nodes that differ here do not run the same code
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
    """Connect to a Dask cluster, and give what opens the engine of a run on it.

    So an address that is wrong is refused before there is a result folder.

    address : of a scheduler, or "local" for one with a worker for each CPU of this
        machine
    plugins : files that nodes find under the same paths
    operators : what puts an operator P together, less what is in `plugins`
    environment : of this process, which nodes are compared with
    keep : stores a node's environment under its digest
    warn : told in a line what the user should know

    Raises
    ------
    InputError
        When Dask is not installed, or there is no such scheduler; while blocks are
        carried out, when a node is not fit to measure on.

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
                    # end the processes of this run and of lost ones; the scheduler may
                    # go while it is asked, as a local one does at Ctrl-C
                    # (CommClosedError is an OSError), or not know of us yet (KeyError)
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
                    f"the Dask scheduler at {address} is gone; start one, and the same "
                    "command continues"
                ) from e

        yield opened


@dataclass(eq=False)
class Nodes:
    """What is known of the machines that have measured."""

    here: Mapping[str, Any]  #: environment of this process
    keep: Keep
    warn: Callable[[str], None]
    _seen: set[str] = field(default_factory=set)  # digests

    def meet(self, node: str, digest: str, environment: Mapping[str, Any]) -> None:
        """Store an environment that is new, and tell how it differs from ours.

        Raises
        ------
        InputError
            When the node runs other code.

        """
        if digest in self._seen:
            return
        changed = list(differences(self.here, environment))
        for key, here, there in changed:
            if key.startswith(_CODE):
                what = in_words([(key, here, there)], "here", "there")
                raise InputError(
                    f"{node} runs other code than this machine ({what}); install the "
                    "same on every node"
                )
        self._seen.add(digest)
        self.keep(digest, environment)
        if changed:
            what = in_words(changed, "here", "there")
            self.warn(
                f"{node} measures under other conditions than this machine ({what}); "
                f"its times are marked as those of environment {digest}"
            )


@dataclass(eq=False, kw_only=True)
class _ActiveBlock:
    """A block, of which one turn at a time is a task of Dask."""

    block: WorkUnit
    left: list[tuple[Record, ...]]  #: turns that no worker has returned yet
    worker: str = ""  #: address of the Dask worker that measures it
    part: int = 0  #: one more whenever a worker was lost after its first turn
    is_measured: bool = False  #: in part: the worker has returned a turn
    lost: int = 0  #: workers that it has cost


@dataclass(eq=False)
class _Cluster:
    """The engine: every Dask worker measures one block, a turn of a solver at a time.

    Tasks are bound to the worker of their block, so that the rest of a block whose
    worker was lost is known here to be another part, measured elsewhere or later.
    """

    client: Any
    name: str  #: of the plug-in of this run
    nodes: Nodes
    address: str
    warn: Callable[[str], None]
    _done: SimpleQueue[Any] = field(default_factory=SimpleQueue)  # futures
    _under_way: dict[Any, _ActiveBlock] = field(
        default_factory=dict
    )  # by their futures
    _left: deque[_ActiveBlock] = field(default_factory=deque)

    def __call__(self, blocks: Iterator[WorkUnit]) -> Iterable[Outcome]:
        """Carry out all of `blocks`."""
        try:
            while self._top_up(blocks):
                try:
                    yield from self._measured(
                        self._done.get(timeout=CLUSTER_POLL_SECONDS)
                    )
                except Empty:
                    if self.client.status != "running":
                        raise _SchedulerGoneError from None
                    # a worker may be busy with a run whose parent has died, and the
                    # scheduler have noticed only now
                    _end_orphaned_runs(self.client)
                yield from self._recovered()
        finally:
            for future in self._under_way:
                future.cancel()

    def _top_up(self, blocks: Iterator[WorkUnit]) -> bool:
        """Give every idle worker a block to do; False when all blocks are done."""
        idle = self._workers() - {active.worker for active in self._under_way.values()}
        while idle or not self._under_way:
            if not self._left and (block := next(blocks, None)) is not None:
                self._left.append(_ActiveBlock(block=block, left=list(block.turns)))
            if not self._left:
                return bool(self._under_way)
            if not idle:
                self.warn(f"waiting for Dask workers to join {self.address}")
                self.client.wait_for_workers(1)
                idle = self._workers()
            if idle:
                active = self._left.popleft()
                active.worker = idle.pop()
                self._submit(active)
        return True

    def _workers(self) -> set[str]:
        """List the addresses of the workers that are there."""
        try:
            return set(self.client.nthreads())
        except OSError as e:
            raise _SchedulerGoneError from e

    def _submit(self, active: _ActiveBlock) -> None:
        """Submit the next turn of a block to its worker."""
        from mortarbench.harness.running.dask_worker import execute

        turn = replace(active.block, turns=(active.left[0],))
        future = self.client.submit(
            execute, self.name, turn, workers=[active.worker], pure=False
        )
        self._under_way[future] = active
        future.add_done_callback(self._done.put)

    def _measured(self, future: Any) -> Iterator[Outcome]:
        """Give back what came of a turn, and submit the next one of its block."""
        from distributed import CancelledError

        if (active := self._under_way.get(future)) is None:  # its worker was lost
            return
        try:
            delivery: Delivery = future.result(timeout=CONNECT_SECONDS)
        except CancelledError as e:  # with the connection
            raise _SchedulerGoneError from e
        except TimeoutError:  # the worker is lost, or about to be found so
            self._done.put(future)
            return
        del self._under_way[future], active.left[0]
        active.is_measured = True
        self.nodes.meet(delivery.node, delivery.digest, delivery.environment)
        for outcome in delivery.outcomes:
            match outcome:
                case BuildFailure():
                    yield replace(outcome, block=active.block)
                    return
                case Result():
                    yield replace(outcome, part=active.part)
                case MeasurementFault():
                    yield outcome
        if active.left:
            self._submit(active)

    def _recovered(self) -> Iterator[Outcome]:
        """Leave the blocks of workers that were lost to others."""
        there = self._workers()
        lost = {f: b for f, b in self._under_way.items() if b.worker not in there}
        for future, active in lost.items():
            del self._under_way[future]
            future.cancel()
            active.lost += 1
            active.part += active.is_measured
            active.is_measured = False
            if active.lost < MAX_LOST_WORKERS:
                self._left.append(active)
            else:
                case = active.block.turns[0][0].case
                reason = f"{case} was given up: every Dask worker that took it was lost"
                yield BuildFailure(block=active.block, reason=reason)


class _SchedulerGoneError(Exception):
    pass


def _connect(address: str, stack: ExitStack) -> Any:
    """Connect to a scheduler, started first if it is to be local.

    Raises
    ------
    InputError
        When there is none.

    """
    from distributed import Client, LocalCluster

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # we tell ourselves
    if address == LOCAL:
        with _delay_interrupt():
            _refuse_unguarded_script()
            cluster = LocalCluster(
                n_workers=len(os.sched_getaffinity(0)),
                threads_per_worker=1,
                memory_limit=0,  # the supervisor's business
                dashboard_address="127.0.0.1:0",  # any free port: several clusters
                scheduler_kwargs={"dashboard": False},
                silence_logs=logging.CRITICAL,
            )
            return stack.enter_context(Client(stack.enter_context(cluster)))
    try:
        return stack.enter_context(Client(address, timeout=CONNECT_SECONDS))
    except Exception as e:  # of any library that a scheme of addresses asks for
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
    """Refuse a main script that would start this run again in every Dask worker.

    Python imports it there before anything else. One process shows what that does, as
    the first of Dask's would; in that process, this function ends the import.

    Raises
    ------
    InputError
        When the script starts a run, or fails, where it is imported.

    """
    if getattr(current_process(), "_inheriting", False):
        raise SystemExit(_UNGUARDED_SCRIPT_CODE)
    first = get_context("spawn").Process(target=int)
    first.start()
    first.join()
    if first.exitcode == _UNGUARDED_SCRIPT_CODE:
        raise InputError(
            "the processes of Dask import the main script, which starts this run once "
            'more there; put what runs below `if __name__ == "__main__":`'
        )
    if first.exitcode:
        raise InputError(
            "the processes of Dask import the main script, which fails there (exit "
            f"code {first.exitcode})"
        )


@contextmanager
def _delay_interrupt() -> Iterator[None]:
    """Keep Ctrl-C from what is started here, and put it off until that is done.

    A terminal sends SIGINT to all processes at once. Dask's would print a traceback
    each; they inherit the mask of this thread, and end with the cluster, which this
    process closes. A second Ctrl-C is not put off.
    """
    if current_thread() is not main_thread():  # which alone is interrupted
        yield
        return
    before = signal.getsignal(signal.SIGINT)
    late = []

    def put_off(*_: object) -> None:  # the signal came to another thread of ours
        late.append(signal.SIGINT)
        signal.signal(signal.SIGINT, before)

    resource_tracker.ensure_running()  # else it is started later, and lifts the mask
    signal.signal(signal.SIGINT, put_off)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, before)
    if late:
        raise KeyboardInterrupt


def _end_orphaned_runs(client: Any) -> None:
    """Have workers end the processes of runs whose parent has died."""

    def lost(dask_scheduler: Any) -> list[str]:
        alive = {f"mortarbench-{client}" for client in dask_scheduler.clients}
        ours = (n for n in dask_scheduler.worker_plugins if n.startswith("mortarbench"))
        return [name for name in ours if name not in alive]

    for name in client.run_on_scheduler(lost):
        client.unregister_worker_plugin(name)
