"""One measurement by a worker process, judged: what `run` and `solve` share."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from math import inf
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.judge import judged, noted, quantities_of
from harness.measure import Measurement
from harness.plugin import Case
from harness.qp import QP
from harness.qpfile import save_qp
from harness.record import Record, Verdict
from harness.solution import Solution, Status
from harness.store import read_point
from harness.supervisor import WorkerProcess

_MEASURED = ("prepare_seconds", "solve_seconds", "total_seconds", "peak_mib")


def measured(
    worker: WorkerProcess,
    qp: QP,
    qp_file: Path,
    record: Record,
    *,
    point: Path,
    time_limit: float,
    memory_limit: float,
) -> tuple[Record, Solution | None]:
    """Fill in `record` by one measurement; no solution where the worker ended.

    qp_file : holds `qp`
    point : where the worker writes its point
    time_limit, memory_limit : s and MiB
    """
    record = record.but(
        sizes=qp.sizes,
        started=datetime.now(UTC).isoformat(timespec="milliseconds"),
    )
    reply = worker.ask(
        {"qp": str(qp_file), "tol": record.tol, "out": str(point)},
        time_limit=time_limit,
        memory_limit=memory_limit,
    )
    if reply.answer is None:
        record = record.but(
            status=reply.verdict, message=reply.message, peak_mib=reply.peak_mib
        )
        return record, None
    answer = reply.answer
    solution = replace(
        read_point(point, Status(answer["claimed"])),
        iterations=answer["iterations"],
        counts=answer["counts"],
        message=answer["message"],
    )
    seconds = {name: answer[name] for name in _MEASURED}
    return judged(record, qp, Measurement(solution=solution, **seconds)), solution


def measured_once(
    command: list[str],
    case: Case,
    record: Record,
    *,
    time_limit: float = inf,
    memory_limit: float = inf,
) -> tuple[Record, Solution | None]:
    """Do as `measured`, with a worker for this one measurement.

    command : starts the worker; two file descriptors are appended to it
    """
    with ExitStack() as stack:
        scratch = Path(stack.enter_context(TemporaryDirectory(prefix="mortarbench-")))
        worker = WorkerProcess(command, scratch / "worker.log")
        stack.callback(worker.close)
        qp_file = scratch / "qp.npz"
        digest = save_qp(qp_file, case.qp, {"name": record.case})
        record, solution = measured(
            worker,
            case.qp,
            qp_file,
            record.but(qp=digest),
            point=scratch / "point.npz",
            time_limit=time_limit,
            memory_limit=memory_limit,
        )
    if solution is None or record.status is Verdict.DECLINED:
        return record, solution
    quantities, note = quantities_of(case, solution)
    return noted(record, note).but(quantities=quantities), solution
