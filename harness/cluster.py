"""More than one machine: the blocks of a run as tasks of Dask distributed.

Every Dask worker carries out one block at a time, with the supervisor that a run on one
machine uses. Dask gives the blocks of a worker that is lost to another one; a result
comes back once. The parent alone writes the result folder.
"""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from harness.block import Block, Commands, Engine, Opens, Outcome, Unbuilt
from harness.errors import InputError, some
from harness.folder import differences

LOCAL = "local"
CONNECT_SECONDS = 10
LOOK_SECONDS = 2.0  #: for workers that joined

Keep = Callable[[str, Mapping[str, Any]], None]

#: of an environment: nodes that differ here do not run the same code
_CODE = ("source", "versions.mortarbench", "plugins")


def on_cluster(
    address: str,
    *,
    plugins: Sequence[Path],
    environment: Mapping[str, Any],
    keep: Keep,
    warn: Callable[[str], None],
) -> Opens:
    """Make what opens the engine of a run on a Dask cluster.

    address : of a scheduler, or "local" for one with a worker for each CPU of this
        machine
    plugins : files that nodes find under the same paths
    environment : of this process, which nodes are compared with
    keep : stores a node's environment under its digest
    warn : told in a line what the user should know

    Raises
    ------
    InputError
        When Dask is not installed; on opening, when there is no such scheduler; while
        blocks are carried out, when a node is not fit to measure on.

    """
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise InputError(
            "--dask needs the package distributed, which is not installed; "
            "pip install -c constraints.txt -e '.[cluster]'"
        ) from None

    @contextmanager
    def opened(commands: Commands, scratch: Path, cases: Path) -> Iterator[Engine]:
        from harness.node import Node

        with ExitStack() as stack:
            client = _connected(address, stack)
            name = f"mortarbench-{client.id}"
            _forget_lost_runs(client)
            files = [file.resolve() for file in plugins]
            client.register_plugin(Node(commands, files, _sharing(client)), name=name)
            stack.callback(_end, client, name)
            nodes = Nodes(environment, keep, warn)
            with _scheduler_there(client, address):
                yield _Cluster(client, name, nodes, address, warn)

    return opened


class Nodes:
    """What is known of the machines that have measured."""

    def __init__(
        self,
        environment: Mapping[str, Any],
        keep: Keep,
        warn: Callable[[str], None],
    ) -> None:
        self._here = environment
        self._keep = keep
        self._warn = warn
        self._seen: set[str] = set()

    def meet(self, node: str, digest: str, environment: Mapping[str, Any]) -> None:
        """Store an environment that is new, and tell how it differs from ours.

        Raises
        ------
        InputError
            When the node runs other code.

        """
        if digest in self._seen:
            return
        changed = list(differences(self._here, environment))
        for key, here, there in changed:
            if key.startswith(_CODE):
                raise InputError(
                    f"{node} runs other code than this machine: {key} is {there} "
                    f"there, {here} here; install the same on every node"
                )
        self._seen.add(digest)
        self._keep(digest, environment)
        if changed:
            keys = some(key for key, *_ in changed)
            self._warn(f"{node} is another environment ({digest}): other {keys}")


class _Cluster:
    """The engine: as many blocks under way as there are Dask workers."""

    def __init__(
        self,
        client: Any,
        name: str,
        nodes: Nodes,
        address: str,
        warn: Callable[[str], None],
    ) -> None:
        self._client = client
        self._name = name
        self._nodes = nodes
        self._address = address
        self._warn = warn

    def __call__(self, blocks: Iterator[Block]) -> Iterable[Outcome]:
        """Carry out all of `blocks`."""
        under_way: dict[Any, Block] = {}
        try:
            more = self._top_up(under_way, blocks)
            while under_way or more:
                for future in self._finished(under_way):
                    block = under_way.pop(future)
                    yield from self._results(future, block, under_way)
                more = more and self._top_up(under_way, blocks)
        finally:
            for future in under_way:
                future.cancel()

    def _top_up(self, under_way: dict[Any, Block], blocks: Iterator[Block]) -> bool:
        """Give every worker a block to do; False when there are no more."""
        workers = len(self._client.nthreads())
        if workers == 0 and not under_way:
            self._warn(f"waiting for Dask workers to join {self._address}")
            self._client.wait_for_workers(1)
            workers = 1
        while len(under_way) < workers:
            block = next(blocks, None)
            if block is None:
                return False
            under_way[self._submitted(block)] = block
        return True

    def _submitted(self, block: Block) -> Any:
        from harness.node import carry_out

        return self._client.submit(carry_out, self._name, block, pure=False)

    def _finished(self, under_way: Mapping[Any, Block]) -> list[Any]:
        """Wait a moment for some to finish; see whether the scheduler is there."""
        from distributed import wait

        try:
            done = wait(list(under_way), LOOK_SECONDS, "FIRST_COMPLETED").done
        except TimeoutError:
            return []
        return [future for future in under_way if future in done]

    def _results(
        self, future: Any, block: Block, under_way: dict[Any, Block]
    ) -> list[Outcome]:
        from distributed import KilledWorker

        if future.status in ("cancelled", "lost") and self._client.status == "running":
            under_way[self._submitted(block)] = block
            return []
        try:
            done = future.result()
        except KilledWorker:
            case = block.turns[0][0].case
            reason = f"{case} was given up: every Dask worker that took it was lost"
            return [Unbuilt(block=block, reason=reason)]
        self._nodes.meet(done.node, done.digest, done.environment)
        results: list[Outcome] = done.results
        return results


def _connected(address: str, stack: ExitStack) -> Any:
    """Connect to a scheduler, started first if it is to be local.

    Raises
    ------
    InputError
        When there is none.

    """
    from distributed import Client, LocalCluster

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # we tell ourselves
    if address == LOCAL:
        cluster = LocalCluster(
            n_workers=len(os.sched_getaffinity(0)),
            threads_per_worker=1,
            memory_limit=0,  # the supervisor's business
            dashboard_address=None,
            silence_logs=logging.CRITICAL,
        )
        return stack.enter_context(Client(stack.enter_context(cluster)))
    try:
        return stack.enter_context(Client(address, timeout=CONNECT_SECONDS))
    except (OSError, ValueError) as e:
        why = " ".join(str(e).split()) or type(e).__name__
        raise InputError(
            f"--dask {address}: no scheduler answers ({why}); expected 'local', or the "
            "address that `dask scheduler` prints, such as tcp://HOST:8786"
        ) from None


@contextmanager
def _scheduler_there(client: Any, address: str) -> Iterator[None]:
    """Turn whatever a scheduler that has gone makes Dask raise into one line.

    Raises
    ------
    InputError
        When the connection is closed.

    """
    try:
        yield
    except Exception as e:
        if isinstance(e, InputError) or client.status == "running":
            raise
        raise InputError(
            f"the Dask scheduler at {address} is gone; start one, and the same command "
            "continues"
        ) from e


def _end(client: Any, name: str) -> None:
    """Have workers end the processes of this run, unless the scheduler is gone.

    It may go while it is asked, as a local one does at Ctrl-C (CommClosedError is an
    OSError), or not know of us yet (KeyError); then nothing is lost.
    """
    with suppress(OSError, KeyError):
        if client.status == "running":
            client.unregister_worker_plugin(name)


def _sharing(client: Any) -> int:
    """Count the workers of the machine that has the most."""
    workers = client.scheduler_info(n_workers=-1)["workers"].values()
    return max(Counter(worker["host"] for worker in workers).values(), default=1)


def _forget_lost_runs(client: Any) -> None:
    """Have workers end the processes of runs whose parent has died."""

    def lost(dask_scheduler: Any) -> list[str]:
        alive = {f"mortarbench-{client}" for client in dask_scheduler.clients}
        ours = (n for n in dask_scheduler.worker_plugins if n.startswith("mortarbench"))
        return [name for name in ours if name not in alive]

    for name in client.run_on_scheduler(lost):
        client.unregister_worker_plugin(name)
