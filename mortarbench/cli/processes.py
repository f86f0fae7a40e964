"""The processes that runs start: a worker per solver, and a generator."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from harness.processes.case_worker import Generator
from harness.processes.case_worker import serve as serve_cases
from harness.processes.worker import serve
from harness.registry import SolverSpec, resolve
from mortarbench.cli.registries import Workbench


def worker(workbench: Workbench, arguments: Sequence[str]) -> int:
    """Be the worker that `Workbench.worker_command` starts."""
    text, request_fd, reply_fd = arguments
    request = json.loads(text)
    workbench = workbench.with_files([Path(file) for file in request["plugins"]])
    spec = SolverSpec(
        name=request["name"], label=request["name"], options=request["options"]
    )
    solver = resolve(spec, workbench.solvers)
    serve(solver, int(request_fd), int(reply_fd), workbench.operators)
    return 0


def generator(workbench: Workbench, arguments: Sequence[str]) -> int:
    """Be the generator that `Workbench.commands` starts."""
    text, request_fd, reply_fd = arguments
    files = [Path(file) for file in json.loads(text)["plugins"]]
    workbench = workbench.with_files(files)
    serve_cases(
        Generator(workbench.families, workbench.reference, workbench.operators),
        int(request_fd),
        int(reply_fd),
    )
    return 0
