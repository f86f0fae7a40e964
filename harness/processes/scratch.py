"""Temporary folders of processes, and the worker of a single solve.

The module imports no numerical library, so that a worker starts before the process that
needs its answer has loaded them.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from time import time

from mortarbench.harness.plugin import Solver
from mortarbench.harness.processes.locks import file_lock
from mortarbench.harness.processes.solver_file import write_solver
from mortarbench.harness.processes.supervisor import WorkerProcess

_SCRATCH = "mortarbench-tmp-"
#: age of folders without a lock from which on they are removed; a new folder is locked
#: after its creation
STALE_SECONDS = 60.0


@contextmanager
def single_worker(
    command: Callable[[Path | None], list[str]], solver: Solver | None = None
) -> Iterator[WorkerProcess]:
    """Start a worker for one solver; the worker ends with the context.

    command : returns the command that starts the worker, without file descriptors; its
        argument is the file with the copy of `solver`
    solver : solver to copy into the worker; None if the command names the solver

    Raises
    ------
    InputError
        If the solver cannot be copied.

    """
    with scratch_folder() as scratch:
        copy = None
        if solver is not None:
            copy = scratch / "solver.pickle"
            write_solver(copy, solver)
        worker = WorkerProcess(command(copy), scratch / "worker.log")
        try:
            worker.start()
            yield worker
        finally:
            worker.close()


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Create a folder for temporary files, removed at the end of the context.

    Each process holds a lock on its folder, which the kernel releases when the process
    ends. Folders without a lock that are older than `STALE_SECONDS` were left behind by
    killed processes, and are removed.
    """
    for stale in Path(gettempdir()).glob(f"{_SCRATCH}*"):
        # the folder is in use, or belongs to another user
        with suppress(OSError), file_lock(stale, flags=os.O_DIRECTORY, waits=False):
            if time() - stale.stat().st_mtime > STALE_SECONDS:
                shutil.rmtree(stale)
    with (
        TemporaryDirectory(prefix=_SCRATCH) as name,
        file_lock(Path(name), flags=os.O_DIRECTORY),
    ):
        yield Path(name)
