"""Main function of the processes of a run: the worker, also on MPI ranks."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mortarbench.harness.distributed.comm import RECORD, Team
from mortarbench.harness.distributed.mpi import too_few_parts
from mortarbench.harness.errors import InputError
from mortarbench.harness.names import assemble
from mortarbench.harness.plugin import Case
from mortarbench.harness.processes.cases import Cases
from mortarbench.harness.processes.ranks import launch
from mortarbench.harness.processes.solver_file import read_solver
from mortarbench.harness.processes.worker import Worker, serve
from mortarbench.harness.registry import SolverSpec, resolve
from mortarbench.registries import Registries, with_history


def worker(registries: Registries, arguments: Sequence[str]) -> int:
    """Run a worker, on one process or on ranks; called by commands of `Registries`.

    arguments : a JSON object, and the file descriptors for requests and replies. The
        worker measures a solver if the object contains its specification, unless it
        also contains ``judges``
    """
    text, request_fd, reply_fd = arguments
    request = json.loads(text)
    ranks = request.get("solver", {}).get("ranks", 1)
    if ranks > 1 and RECORD not in os.environ:  # not started by mpiexec
        return launch(ranks, [*registries.start, "worker", *arguments])
    registries = registries.with_files(request["plugins"])
    solver = None
    if "solver" in request and "judges" not in request:
        spec, solvers = SolverSpec(**request["solver"]), registries.solvers
        if "copy" in request:
            solvers = {spec.name: read_solver(Path(request["copy"]))}
        if request["records"]:
            spec = with_history(spec, solvers)
        solver = resolve(spec, solvers)

    if ranks > 1:  # all ranks import at the same time what they need later
        from mortarbench.problems.feti import elastic, served

        del elastic, served

    def build(case: Mapping[str, Any], team: Team) -> Case:
        from mortarbench.solvers.reference.operators import reference_of_operator

        name = case["family"]
        case_id = assemble(
            name, registries.families[name], case["params"], case["form"]
        )
        parts = case_id.family.divided(case_id.form)
        if parts is None or parts.subdomains < team.comm.size:
            count = 1 if parts is None else parts.subdomains
            raise InputError(too_few_parts(count, team.comm.size))
        return parts.build(team, reference_of_operator)

    work = Worker(
        solver=solver,
        cases=Cases(registries.families, registries.reference),
        operators=registries.operators,
    )
    serve(work, int(request_fd), int(reply_fd), build if ranks > 1 else None)
    return 0
