"""Execution of blocks on a Dask cluster, in which each block is a task.

A Dask worker measures one block at a time with the executor of a run on one machine,
so that the times of a block are measured in succession on one machine. If a worker is
lost, Dask gives its block to another worker, which measures the whole block. Only the
parent writes to the result folder.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from subprocess import DEVNULL, Popen
from tempfile import TemporaryDirectory
from typing import Any

from mortarbench.harness.environment.environment import digest, packages_of
from mortarbench.harness.environment.labels import in_words
from mortarbench.harness.errors import InputError
from mortarbench.harness.operators import Maker
from mortarbench.harness.registry import PluginFile
from mortarbench.harness.results.folder import differences
from mortarbench.harness.results.work_unit import (
    BuildFailure,
    Commands,
    Outcome,
    WorkUnit,
)

LOCAL = "local"
CONNECT_SECONDS = 10  #: time limit for connecting
#: longest time between two checks for workers that joined or were lost
CLUSTER_POLL_SECONDS = 2.0
LOST_SECONDS = 30.0  #: time in which a lost worker may be replaced

#: keys of an environment in which all nodes must agree to run the same code
_CODE = ("source", "versions.mortarbench", "plugins")


@contextmanager
def on_cluster(address: str, **settings: Any) -> Iterator[Cluster]:
    """Connect to a Dask cluster, before a result folder is created.

    address : address of a scheduler, or "local" to start a scheduler with a worker for
        each CPU that this process may use
    settings : further fields of `Cluster`

    Raises
    ------
    InputError
        If Dask is not installed, or the scheduler does not answer.

    """
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise InputError(
            "--dask needs the package distributed, which is not installed; "
            "pip install -c constraints.txt -e '.[cluster]'"
        ) from None
    # Dask would also log the errors that are reported here, with tracebacks.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        where: Any = address
        if address == LOCAL:
            where = LocalCluster(
                n_workers=0,
                # use any free port, so that several clusters can coexist
                dashboard_address="127.0.0.1:0",
                scheduler_kwargs={"dashboard": False},
                silence_logs=logging.CRITICAL,
            )
            stack.enter_context(where)
            stack.enter_context(_local_workers(where.scheduler_address))
        try:
            client = stack.enter_context(Client(where, timeout=CONNECT_SECONDS))
        # the library of each address scheme raises its own exceptions
        except Exception as e:
            why = " ".join(str(e).split()) or type(e).__name__
            raise InputError(
                f"--dask {address}: no scheduler answers ({why}); expected 'local', or "
                "the address that `dask scheduler` prints, such as tcp://HOST:8786"
            ) from None
        yield Cluster(client=client, address=address, **settings)


@contextmanager
def _local_workers(scheduler: str) -> Iterator[None]:
    """Start a Dask worker for each usable CPU, which Ctrl-C does not reach."""
    with TemporaryDirectory(prefix="mortarbench-") as folder:
        command = [sys.executable, "-P", "-m", "dask", "worker", scheduler]
        command += ["--nworkers", str(len(os.sched_getaffinity(0))), "--nthreads", "1"]
        command += ["--memory-limit", "0", "--no-dashboard", "--death-timeout", "30"]
        command += ["--local-directory", folder]
        workers = Popen(command, stdout=DEVNULL, stderr=DEVNULL, start_new_session=True)
        try:
            yield
        finally:
            os.killpg(workers.pid, signal.SIGKILL)
            workers.wait()


@dataclass(eq=False, kw_only=True)
class Cluster:
    """Connection to a Dask cluster that executes the blocks of one run."""

    client: Any
    address: str
    plugins: Sequence[PluginFile]
    operators: Mapping[str, Maker]  #: makers of operators P, except those of `plugins`
    environment: Mapping[str, Any]  #: environment of this process
    keep: Callable[[str, Mapping[str, Any]], None]  #: stores an environment by digest
    warn: Callable[[str], None]  #: called with each message to the user, a single line
    _stored: set[str] = field(default_factory=set)  # digests of stored environments

    def execute(
        self, blocks: Iterator[WorkUnit], commands: Commands, scratch: Path
    ) -> Generator[Outcome]:
        """Execute all blocks, and yield the outcomes of a block when it is complete.

        Raises
        ------
        InputError
            If a node is unsuitable, or if the scheduler or all workers are lost.

        """
        from distributed import KilledWorker, wait

        pending: dict[Any, WorkUnit] = {}  # submitted blocks by future
        try:
            self._await_workers(None)
            task = self._task(commands)
            while True:
                self._await_workers(LOST_SECONDS)
                free = len(self.client.nthreads()) - len(pending)
                while free > 0 and (block := next(blocks, None)) is not None:
                    pending[self.client.submit(task, block, pure=False)] = block
                    free -= 1
                if not pending:
                    return
                with suppress(TimeoutError):
                    wait(
                        [*pending], CLUSTER_POLL_SECONDS, return_when="FIRST_COMPLETED"
                    )
                for future in [each for each in pending if each.done()]:
                    block = pending.pop(future)
                    try:
                        outcomes, *there = future.result()
                    except KilledWorker:
                        case = block.turns[0][0].case
                        reason = f"{case} was given up: its Dask workers were lost"
                        outcomes = [BuildFailure(block=block, reason=reason)]
                    else:
                        self.add_node(*there)
                    yield from outcomes
        except Exception as e:
            if isinstance(e, InputError) or self.client.status == "running":
                raise
            raise InputError(
                f"the Dask scheduler at {self.address} is gone; start a scheduler at "
                "this address, and repeat the command to continue"
            ) from e
        finally:
            with suppress(Exception):  # the scheduler may be gone
                self.client.cancel([*pending], force=True)

    def _task(self, commands: Commands) -> Callable[[WorkUnit], Any]:
        """Return the function that measures a block in a Dask worker."""
        from mortarbench.harness.running.dask_worker import measure

        return partial(
            measure,
            run=self.client.id,
            commands=commands,
            plugins=tuple(file.resolved() for file in self.plugins),
            operators=dict(self.operators),
            packages=tuple(packages_of(self.environment)),
        )

    def _await_workers(self, seconds: float | None) -> None:
        """Wait until the cluster has a worker.

        Raises
        ------
        InputError
            If there is no worker after `seconds`.

        """
        if self.client.nthreads():
            return
        if self.address != LOCAL:
            self.warn(f"waiting for Dask workers to join {self.address}")
        try:
            self.client.wait_for_workers(1, seconds)
        except TimeoutError:
            raise InputError(
                f"all Dask workers of {self.address} were lost; start workers, and "
                "repeat the command to continue"
            ) from None

    def add_node(self, node: str, environment: Mapping[str, Any]) -> None:
        """Store the environment of a node if it is new.

        Raises
        ------
        InputError
            If the node runs a different version of the code.

        """
        name = digest(environment)
        if name in self._stored:
            return
        changed = differences(self.environment, environment)
        if code := [each for each in changed if each[0].startswith(_CODE)]:
            raise InputError(
                f"{node} runs different code from this machine "
                f"({in_words(code, 'here', 'there')}); install the same code on every "
                "node"
            )
        self._stored.add(name)
        self.keep(name, environment)
