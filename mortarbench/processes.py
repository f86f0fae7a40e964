"""Main functions of the processes of a run: the worker, also on MPI ranks."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mortarbench.harness.distributed.comm import Comm
from mortarbench.harness.distributed.mpi import too_few_parts
from mortarbench.harness.errors import InputError
from mortarbench.harness.names import assemble
from mortarbench.harness.plugin import CaseOnRanks
from mortarbench.harness.processes.cases import Cases
from mortarbench.harness.processes.ranks import launch
from mortarbench.harness.processes.solver_file import read_solver
from mortarbench.harness.processes.worker import Worker, serve
from mortarbench.harness.registry import SolverSpec, resolve
from mortarbench.harness.suite.solver_options import typed
from mortarbench.registries import Registries, with_history


def worker(registries: Registries, arguments: Sequence[str]) -> int:
    """Run a worker; called by the commands of `Registries`.

    arguments : a JSON object, and the file descriptors for requests and replies. The
        worker measures a solver if the object contains its ``name``
    """
    text, request_fd, reply_fd = arguments
    request = json.loads(text)
    registries = registries.with_files(request["plugins"])
    solver = None
    if "name" in request:
        name, solvers = request["name"], registries.solvers
        if "copy" in request:
            solvers = {name: read_solver(Path(request["copy"]))}
        spec = SolverSpec(name=name, label=name, options=request["options"])
        spec = typed(spec, solvers)
        if request["records"]:
            spec = with_history(spec, solvers)
        solver = resolve(spec, solvers)

    def build(case: Mapping[str, Any], comm: Comm) -> CaseOnRanks:
        from mortarbench.solvers.reference.operators import reference_of_operator

        name = case["family"]
        case_id = assemble(
            name, registries.families[name], case["params"], case["form"]
        )
        on_ranks = case_id.family.on_ranks(case_id.form)
        if on_ranks is None:
            raise InputError(too_few_parts(1, comm.size))
        return on_ranks(comm, reference_of_operator)

    work = Worker(
        solver=solver,
        cases=Cases(registries.families, registries.reference),
        operators=registries.operators,
    )
    is_parallel = request.get("ranks", 1) > 1
    serve(work, int(request_fd), int(reply_fd), build if is_parallel else None)
    return 0


def ranks(registries: Registries, arguments: Sequence[str]) -> int:
    """Start a worker on several MPI ranks; called by the command of `worker_command`.

    arguments : see `worker`
    """
    count = json.loads(arguments[0])["ranks"]
    return launch(count, [*registries.start, "worker", *arguments])
