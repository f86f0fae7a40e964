"""Execution of a block in a Dask worker."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from tempfile import gettempdir
from typing import Any

from distributed import get_worker

from mortarbench.harness.checked import located
from mortarbench.harness.environment.cpus import fastest_first
from mortarbench.harness.environment.environment import capture_in_worker, digest
from mortarbench.harness.errors import InputError
from mortarbench.harness.operators import Maker
from mortarbench.harness.processes.locks import file_lock
from mortarbench.harness.registry import PluginFile, load_plugin, merged
from mortarbench.harness.results.work_unit import Commands, Outcome, WorkUnit
from mortarbench.harness.running.executor import Executor

_LOCKS = ExitStack()  # locks that this process holds until it ends


def measure(
    block: WorkUnit,
    *,
    run: str,
    commands: Commands,
    plugins: tuple[PluginFile, ...],
    operators: Mapping[str, Maker],
    packages: tuple[str, ...],
) -> tuple[list[Outcome], str, dict[str, Any]]:
    """Measure a block in a Dask worker; stop early if the run has ended.

    run : name that no other run on the cluster has
    operators : makers of operators P, except those of the plug-ins
    packages : packages whose versions an environment contains

    The CPU of this Dask worker also measures the blocks of its other runs.

    Returns
    -------
    outcomes, host name and environment of this machine

    Raises
    ------
    InputError
        If this machine is unsuitable for measurements, or its disk is full.

    """
    worker, node = get_worker(), platform.node()
    if worker.state.nthreads != 1:
        raise InputError(
            f"the Dask worker {worker.name} on {node} takes {worker.state.nthreads} "
            "blocks at a time, so that they would disturb each other; start it with "
            "--nthreads 1"
        )
    environment = _environment(run, plugins, packages)
    name = digest(environment)
    for file in plugins:
        operators = merged("operator", operators, load_plugin(file).operators)

    turns = tuple(
        tuple(record.replace(environment=name, node=node) for record in turn)
        for turn in block.turns
    )
    os.sched_setaffinity(0, {claim_cpu()})  # binds only this thread
    scratch = Path(worker.local_directory, f"mortarbench-{run}")
    scratch.mkdir(exist_ok=True)
    task = worker.state.tasks[worker.get_current_task()]
    outcomes: list[Outcome] = []
    executor = Executor(commands, scratch, operators)
    with closing(executor), located(node):  # the disk of this machine may be full
        for outcome in executor.execute(replace(block, turns=turns)):
            outcomes.append(outcome)
            if task.state != "executing":
                break
    return outcomes, node, environment


@lru_cache(maxsize=1)
def _environment(
    run: str, plugins: tuple[PluginFile, ...], packages: tuple[str, ...]
) -> dict[str, Any]:
    """Return the environment of this node, captured once for each run."""
    return capture_in_worker(plugins, packages)


@cache
def claim_cpu() -> int:
    """Reserve a CPU that no other Dask worker of this user on this machine uses.

    The reservation is a file lock, which the kernel releases when the process ends.

    Raises
    ------
    InputError
        If all CPUs are taken.

    """
    usable = fastest_first(os.sched_getaffinity(os.getpid()))
    for cpu in usable:
        lock = Path(gettempdir(), f"mortarbench-{os.getuid()}-cpu{cpu}.lock")
        # the CPU is in use, or the file is a link or belongs to another user
        with suppress(OSError):
            _LOCKS.enter_context(
                file_lock(lock, flags=os.O_RDWR | os.O_CREAT, waits=False)
            )
            return cpu
    raise InputError(
        f"{platform.node()} has {len(usable)} usable CPUs, and as many Dask workers "
        "use them already; start fewer workers"
    )
