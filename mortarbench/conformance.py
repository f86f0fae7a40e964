"""The conformance suite on one solver, in a process of its own."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack

from harness.conformance.conformance import FINDS, KEEPS, Grade, Result
from harness.processes.measurement import scratch_folder
from harness.processes.supervisor import WorkerProcess

TIME_LIMIT = 60.0  #: s per check
MEMORY_LIMIT = 4096.0  #: MiB per check


def conforms(results: Mapping[str, Result]) -> bool:
    """Whether no check fails, and the solver solved something."""
    solved = any(
        r.grade is Grade.PASS and name.startswith(FINDS) for name, r in results.items()
    )
    return solved and all(r.grade is not Grade.FAIL for r in results.values())


def examined(
    command: list[str], checks: Iterable[str], time_limit: float = TIME_LIMIT
) -> Iterator[tuple[str, Result]]:
    """Run checks; what kills or hangs the solver's process fails one check only.

    command : starts the worker; two file descriptors are appended to it
    """
    with ExitStack() as stack:
        scratch = stack.enter_context(scratch_folder())
        worker = WorkerProcess(command, scratch / "worker.log")
        stack.callback(worker.close)
        for name in checks:
            reply = worker.ask(
                {"check": name}, time_limit=time_limit, memory_limit=MEMORY_LIMIT
            )
            if reply.answer is None:
                weak = name.startswith(KEEPS)
                yield name, Result(Grade.WEAK if weak else Grade.FAIL, reply.message)
            else:
                grade, *others = (reply.answer[field] for field in Result._fields)
                yield name, Result(Grade(grade), *others)
