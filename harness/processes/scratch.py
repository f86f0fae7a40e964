"""Temporary folders of processes, and the worker of a single solve.

The module imports no numerical library, so that a worker starts before the process that
needs its answer has loaded them.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

from mortarbench.harness.plugin import Solver
from mortarbench.harness.processes.locks import file_lock
from mortarbench.harness.processes.solver_file import write_solver
from mortarbench.harness.processes.supervisor import WorkerProcess

_SCRATCH = "mortarbench-tmp-"


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
    ends. Folders without a lock were left behind by killed processes, and are removed.
    """
    for stale in Path(gettempdir()).glob(f"{_SCRATCH}*"):
        # the folder is in use, or belongs to another user
        with suppress(OSError), file_lock(stale, flags=os.O_DIRECTORY, waits=False):
            shutil.rmtree(stale)
    while True:
        with TemporaryDirectory(prefix=_SCRATCH) as name, ExitStack() as stack:
            folder = Path(name)
            with suppress(FileNotFoundError):
                stack.enter_context(file_lock(folder, flags=os.O_DIRECTORY))
            # Before the new folder is locked, another process may treat it as abandoned
            # and remove it. In this case, another folder is created.
            if folder.exists():
                yield folder
                return
