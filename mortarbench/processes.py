"""Main functions of the processes of a run: workers, MPI ranks and the case worker."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mortarbench.harness.distributed.vectors import DistributedQP, Ranks
from mortarbench.harness.errors import InputError
from mortarbench.harness.processes.case_worker import CaseWorker
from mortarbench.harness.processes.case_worker import serve as serve_cases
from mortarbench.harness.processes.ranks import launch, this_rank
from mortarbench.harness.processes.solver_file import read_solver
from mortarbench.harness.processes.worker import serve
from mortarbench.harness.registry import SolverSpec, resolve, stand_for_harness
from mortarbench.registries import Registries


def worker(registries: Registries, arguments: Sequence[str]) -> int:
    """Run a worker; called by the command that `Registries.worker_command` returns.

    arguments : a JSON object, and the file descriptors for requests and replies
    """
    text, request_fd, reply_fd = arguments
    request = json.loads(text)
    stand_for_harness()
    registries = registries.with_files(request["plugins"])
    spec = SolverSpec(
        name=request["name"], label=request["name"], options=request["options"]
    )
    solvers = registries.solvers
    if "copy" in request:
        solvers = {spec.name: read_solver(Path(request["copy"]))}
    solver = resolve(spec, solvers)
    ranks = this_rank() if request.get("ranks", 1) > 1 else None

    def emit(case: Mapping[str, Any], ranks: Ranks) -> DistributedQP:
        from mortarbench.solvers.reference.operators import reference_of_operator

        family = registries.families[case["family"]]
        emission = family.emission(case["form"], case["params"])
        if emission is None:
            raise InputError(f"{family.name}: ranks cannot assemble this case")
        return emission(ranks, reference_of_operator)

    serve(
        solver,
        int(request_fd),
        int(reply_fd),
        registries.operators,
        ranks,
        emit,
    )
    return 0


def ranks(registries: Registries, arguments: Sequence[str]) -> int:
    """Start a worker on several MPI ranks; called by the command of `worker_command`.

    arguments : see `worker`
    """
    count = json.loads(arguments[0])["ranks"]
    return launch(count, [*registries.start, "worker", *arguments])


def case_worker(registries: Registries, arguments: Sequence[str]) -> int:
    """Run the case worker; called by `case_worker` of `Registries.commands`.

    arguments : a JSON object, and the file descriptors for requests and replies
    """
    text, request_fd, reply_fd = arguments
    request = json.loads(text)
    stand_for_harness()
    registries = registries.with_files(request["plugins"])
    families = registries.families
    if "folder" in request:
        families = registries.families_with_copies(Path(request["folder"]))
    serve_cases(
        CaseWorker(families, registries.reference, registries.operators),
        int(request_fd),
        int(reply_fd),
    )
    return 0
