"""The command that runs the conformance suite on a solver, in a process of its own."""

from __future__ import annotations

import json
from argparse import Namespace
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

from harness import show
from harness.conformance import CHECKS, FINDS, Grade, Result
from harness.registry import SolverSpec, resolve
from harness.supervisor import WorkerProcess
from harness.workbench import Workbench

TIME_LIMIT = 60.0  #: s per check
MEMORY_LIMIT = 4096.0  #: MiB per check


def test_solver(workbench: Workbench, options: Namespace) -> int:
    """Run every check; 1 if one fails, or if the solver solved nothing at all."""
    workbench = workbench.with_files(options.plugin)
    spec = SolverSpec(name=options.solver, label=options.solver)
    resolve(spec, workbench.solvers)
    command = workbench.worker_command(spec, options.plugin)
    results = dict(examined(command))
    grades = Counter(r.grade for r in results.values())
    if options.json:
        rows = [dict(check=name, **r._asdict()) for name, r in results.items()]
        print(json.dumps(rows))
    else:
        print(show.aligned([r.grade, name, r.message] for name, r in results.items()))
        counted = ", ".join(f"{grades[g]} {g}" for g in Grade)
        print(f"{options.solver}: {counted}")
    solved = any(
        r.grade is Grade.PASS and name.startswith(FINDS) for name, r in results.items()
    )
    return 0 if solved and not grades[Grade.FAIL] else 1


def examined(
    command: list[str], time_limit: float = TIME_LIMIT
) -> Iterator[tuple[str, Result]]:
    """Run every check; what kills or hangs the solver's process fails one check only.

    command : starts the worker; two file descriptors are appended to it
    """
    with ExitStack() as stack:
        scratch = Path(stack.enter_context(TemporaryDirectory(prefix="mortarbench-")))
        worker = WorkerProcess(command, scratch / "worker.log")
        stack.callback(worker.close)
        for name in CHECKS:
            reply = worker.ask(
                {"check": name}, time_limit=time_limit, memory_limit=MEMORY_LIMIT
            )
            if reply.answer is None:
                yield name, Result(Grade.FAIL, reply.message)
            else:
                grade = Grade(reply.answer["grade"])
                yield name, Result(grade, reply.answer["message"])
