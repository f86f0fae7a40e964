"""The command `test-solver`: the conformance suite on solvers."""

from __future__ import annotations

import fnmatch
import json
from argparse import Namespace
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack
from typing import TYPE_CHECKING

from harness.registry import SolverSpec, check_name, resolve
from mortarbench.registries import Registries
from mortarbench.text import aligned

if TYPE_CHECKING:
    from harness.conformance.conformance import Result

TIME_LIMIT = 60.0  #: s per check
MEMORY_LIMIT = 4096.0  #: MiB per check


def run(registries: Registries, options: Namespace) -> int:
    """Run every check; 1 if one fails, or if a solver solved nothing at all."""
    registries = registries.with_files(options.plugin)
    specs = [
        SolverSpec(name=name, label=name)
        for pattern in options.solver
        for name in _named(pattern, registries.solvers)
    ]
    for spec in specs:
        check_name(spec.name, registries.solvers)
    from harness.conformance.conformance import CHECKS, KEEPS
    from harness.conformance.weaknesses import weaknesses_page

    for spec in specs:
        resolve(spec, registries.solvers)
    checks = [c for c in CHECKS if c.startswith(KEEPS) or not options.markdown]
    results = {}
    for spec in specs:
        command = registries.worker_command(spec)
        results[spec.name] = dict(examined(command, checks))
        if not options.json and not options.markdown:
            _show(spec.name, results[spec.name])
    if options.markdown:
        print(weaknesses_page(results), end="")
        return 0
    if options.json:
        rows = [
            dict(solver=solver, check=name, **r._asdict())
            for solver, found in results.items()
            for name, r in found.items()
        ]
        print(json.dumps(rows))
    return 0 if all(map(conforms, results.values())) else 1


def _named(pattern: str, solvers: Collection[str]) -> list[str]:
    """List the solvers of a registry that a pattern means; a name means itself."""
    if "*" not in pattern or pattern in solvers:
        return [pattern]
    found = [s for s in fnmatch.filter(solvers, pattern) if not s.endswith(":*")]
    return found or [pattern]


def _show(solver: str, results: Mapping[str, Result]) -> None:
    from harness.conformance.conformance import Grade

    print(aligned([r.grade, name, r.message] for name, r in results.items()))
    grades = Counter(r.grade for r in results.values())
    print(f"{solver}: {', '.join(f'{grades[g]} {g}' for g in Grade)}")


def conforms(results: Mapping[str, Result]) -> bool:
    """Whether no check fails, and the solver solved something."""
    from harness.conformance.conformance import FINDS, Grade

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
    from harness.conformance.conformance import KEEPS, Grade, Result
    from harness.processes.measurement import scratch_folder
    from harness.processes.supervisor import WorkerProcess

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
