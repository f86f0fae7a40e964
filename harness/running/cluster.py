"""Execution of blocks on a Dask cluster, in which each block is a task.

A Dask worker measures one block at a time with the executor of a run on one machine,
so that the times of a block are measured in succession on one machine. If a worker is
lost, Dask gives its block to another worker, which measures the whole block. Only the
parent writes to the result folder.
"""

from __future__ import annotations

import logging
import os
import platform
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from threading import Lock
from typing import Any

from mortarbench.harness.checked import located
from mortarbench.harness.environment.cpus import fastest_first
from mortarbench.harness.environment.environment import (
    capture,
    digest,
    packages_of,
)
from mortarbench.harness.environment.labels import in_words
from mortarbench.harness.errors import InputError, described, one_line
from mortarbench.harness.operators import Maker
from mortarbench.harness.processes.scratch import scratch_folder
from mortarbench.harness.registry import PluginFile, load_plugin, merged
from mortarbench.harness.results.folder import differences
from mortarbench.harness.results.work_unit import (
    BuildFailure,
    Commands,
    Execute,
    Outcome,
    WorkUnit,
)
from mortarbench.harness.running.executor import execute

LOCAL = "local"
CONNECT_SECONDS = 10  #: time limit for connecting
CLUSTER_POLL_SECONDS = 2.0  #: longest time between two checks for lost workers
LOST_SECONDS = 60.0  #: time in which the first worker may join, or a lost one return

#: keys of an environment in which all nodes must agree to run the same code
_CODE = ("source", "versions.mortarbench", "plugins")
_TURN = Lock()  #: held while this Dask worker measures a block


@contextmanager
def on_cluster(
    address: str,
    *,
    plugins: Sequence[PluginFile],
    operators: Mapping[str, Maker],
    environment: Mapping[str, Any],
    keep: Callable[[str, Mapping[str, Any]], None],
) -> Iterator[Execute]:
    """Connect to a Dask cluster, and provide a function that executes blocks there.

    address : address of a scheduler, or "local" to start a scheduler with a worker for
        each CPU that this process may use
    operators : makers of operators P, except those of `plugins`
    environment : environment of this process
    keep : stores the environment of a node by its digest

    Raises
    ------
    InputError
        If Dask is not installed, or the scheduler does not answer.

    """
    # Dask would also log the errors that are reported here, with tracebacks.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        try:
            from distributed import Client, LocalCluster

            where: Any = address
            if address == LOCAL:
                where = LocalCluster(
                    n_workers=len(os.sched_getaffinity(0)),
                    threads_per_worker=1,
                    memory_limit=0,
                    dashboard_address="127.0.0.1:0",  # any free port
                    silence_logs=logging.CRITICAL,
                )
                stack.enter_context(where)
            client = stack.enter_context(Client(where, timeout=CONNECT_SECONDS))
        # the library of each address scheme raises its own exceptions
        except Exception as e:
            raise InputError(
                f"--dask {address}: {one_line(described(e))}; expected 'local' or the "
                "address that `dask scheduler` prints, such as tcp://HOST:8786, and "
                "the package distributed (pip install -e '.[cluster]')"
            ) from None
        task = partial(
            measure,
            spread=address == LOCAL,
            plugins=tuple(file.resolved() for file in plugins),
            operators=dict(operators),
            here=environment,
        )
        yield partial(_execute, client=client, task=task, keep=keep)


def _execute(
    blocks: Iterator[WorkUnit],
    commands: Commands,
    scratch: Path,
    *,
    client: Any,
    task: Callable[..., Any],
    keep: Callable[[str, Mapping[str, Any]], None],
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
        while True:
            client.wait_for_workers(1, LOST_SECONDS)
            free = max(0, len(client.nthreads()) - len(pending))
            for block in islice(blocks, free):
                pending[client.submit(task, block, commands, pure=False)] = block
            if not pending:
                return
            with suppress(TimeoutError):
                wait([*pending], CLUSTER_POLL_SECONDS, return_when="FIRST_COMPLETED")
            for future in [each for each in pending if each.done()]:
                block = pending.pop(future)
                try:
                    outcomes, environment = future.result()
                    keep(digest(environment), environment)
                except KilledWorker:
                    reason = (
                        f"{block.cases[0]} was given up: its Dask workers were lost"
                    )
                    outcomes = [BuildFailure(block=block, reason=reason)]
                yield from outcomes
    except (OSError, CancelledError) as e:  # also for a TimeoutError
        raise InputError(
            f"the Dask scheduler or all its workers are gone ({described(e)}); start "
            "them again, and repeat the command to continue"
        ) from e
    finally:
        with suppress(Exception):  # the scheduler may be gone
            client.cancel([*pending], force=True)


def measure(
    block: WorkUnit,
    commands: Commands,
    *,
    spread: bool,
    plugins: tuple[PluginFile, ...],
    operators: Mapping[str, Maker],
    here: Mapping[str, Any],
) -> tuple[list[Outcome], dict[str, Any]]:
    """Measure a block in a Dask worker; stop early if the run has ended.

    spread : True if the workers are numbered, on one machine; the number of a worker
        then selects its CPU
    operators : makers of operators P, except those of the plug-ins
    here : environment of the parent

    Returns
    -------
    outcomes and environment of this machine

    Raises
    ------
    InputError
        If this machine runs different code, or its disk is full.

    """
    from distributed import get_worker

    worker, node = get_worker(), platform.node()
    environment = capture(plugins, packages_of(here))
    refuse_other_code(node, here, environment)
    for file in plugins:
        operators = merged("operator", operators, load_plugin(file).operators)
    changes = {"environment": digest(environment), "node": node}
    turns = [tuple(r.replace(**changes) for r in turn) for turn in block.turns]
    if spread:
        cpus = fastest_first(os.sched_getaffinity(os.getpid()))
        os.sched_setaffinity(0, {cpus[worker.name]})  # binds only this thread
    task = worker.state.tasks[worker.get_current_task()]
    outcomes: list[Outcome] = []
    # the disk of this machine may be full
    with _TURN, located(node), scratch_folder() as scratch:
        units = iter([replace(block, turns=tuple(turns))])
        with closing(execute(units, commands, scratch, operators=operators)) as made:
            for outcome in made:
                outcomes.append(outcome)
                if task.state != "executing":
                    break
    return outcomes, environment


def refuse_other_code(
    node: str, here: Mapping[str, Any], there: Mapping[str, Any]
) -> None:
    """Raise InputError if a node runs other code than the parent.

    here, there : environments of the parent and of the node
    """
    code = [d for d in differences(here, there) if d[0].startswith(_CODE)]
    if code:
        raise InputError(
            f"{node} runs different code from this machine "
            f"({in_words(code, 'here', 'there')}); install the same code on every node"
        )
