"""One measurement by a worker process, judged: what `run` and `solve` share."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from math import inf
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.judge import judged
from harness.measure import Measurement
from harness.plugin import Case
from harness.qpfile import save_qp
from harness.record import Record
from harness.solution import Solution, Status
from harness.store import read_point
from harness.supervisor import WorkerProcess

_MEASURED = ("prepare_seconds", "solve_seconds", "total_seconds", "peak_mib")


def hand_over(case: Case, name: str, scratch: Path) -> Path:
    """Write the QP of a case, of that canonical name, to where workers read it."""
    qp_file = scratch / "qp.npz"
    save_qp(qp_file, case.qp, {"name": name})
    return qp_file


def measured(
    worker: WorkerProcess,
    case: Case,
    qp_file: Path,
    record: Record,
    *,
    time_limit: float,
    memory_limit: float,
) -> tuple[Record, Solution | None]:
    """Fill in `record` by one measurement; no solution where the worker ended.

    qp_file : from `hand_over`; the worker writes its point next to it
    time_limit, memory_limit : s and MiB
    """
    record = record.but(
        sizes=case.qp.sizes,
        started=datetime.now(UTC).isoformat(timespec="milliseconds"),
    )
    point = qp_file.with_name("point.npz")
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
        reported={k: v for k, v in answer["reported"].items() if v is not None},
        message=answer["message"],
    )
    seconds = {name: answer[name] for name in _MEASURED}
    return judged(record, case, Measurement(solution=solution, **seconds)), solution


def measured_once(
    command: list[str], case: Case, record: Record
) -> tuple[Record, Solution | None]:
    """Do as `measured`, with a worker for this one measurement and without limits.

    command : starts the worker; two file descriptors are appended to it
    """
    with ExitStack() as stack:
        scratch = Path(stack.enter_context(TemporaryDirectory(prefix="mortarbench-")))
        worker = WorkerProcess(command, scratch / "worker.log")
        stack.callback(worker.close)
        qp_file = hand_over(case, record.case, scratch)
        return measured(worker, case, qp_file, record, time_limit=inf, memory_limit=inf)
