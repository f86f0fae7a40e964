"""One measurement by a worker process, judged: what `run` and `solve` share."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from math import inf, isinf
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from harness.cases import content_digest
from harness.judge import certified, judged, noted, quantities_of
from harness.measure import Measurement
from harness.plugin import Case
from harness.qp import QP
from harness.qpfile import save_qp
from harness.record import Record, Verdict
from harness.solution import Solution, Status
from harness.store import read_point
from harness.supervisor import WorkerProcess, out_of_memory

_MEASURED = (
    "prepare_seconds",
    "solve_seconds",
    "total_seconds",
    "prepare_peak_mib",
    "solve_peak_mib",
    "inner",
)


def measured(
    worker: WorkerProcess,
    qp: QP,
    record: Record,
    request: Mapping[str, Any],
    *,
    time_limit: float,
    memory_limit: float,
) -> tuple[Record, Solution | None]:
    """Fill in `record` by one measurement; no solution where the worker ended.

    request : to the worker, see `harness.worker`; less what stands in the record
    time_limit, memory_limit : s and MiB
    """
    limited = {} if isinf(memory_limit) else {"memory_limit": memory_limit}
    started = datetime.now(UTC).isoformat(timespec="milliseconds")
    reply = worker.ask(
        {**request, **limited, "tol": record.tol},
        time_limit=time_limit,
        memory_limit=memory_limit,
    )
    record = record.but(
        sizes=qp.sizes,
        started=started,
        message=reply.message,
        peak_mib=reply.peak_mib,
        threads=reply.threads,
        cpu=reply.cpu,
    )
    if reply.answer is None:
        return record.but(status=reply.verdict), None
    answer = reply.answer
    solution = replace(
        read_point(Path(request["out"]), Status(answer["claimed"])),
        iterations=answer["iterations"],
        counts=answer["counts"],
        reported={k: v for k, v in answer["reported"].items() if v is not None},
        message=answer["message"],
    )
    told = {name: answer[name] for name in _MEASURED}
    record = judged(record, qp, Measurement(solution=solution, **told))
    return _within(memory_limit, record).but(
        canary_seconds=answer["canary_seconds"]
    ), solution


def _within(limit: float, record: Record) -> Record:
    """Say so where an answer went beyond the memory limit, or failed because of it."""
    if record.status is Verdict.DECLINED:
        return record
    peak = record.peak_mib
    if peak is not None and peak > limit:
        message = f"reached {peak:.0f} MiB, above the limit of {limit:g} MiB"
        return noted(record.but(status=Verdict.MEMORY_LIMIT), message)
    succeeded = record.status in (Verdict.VERIFIED, Verdict.INACCURATE)
    if not succeeded and out_of_memory(record.message, peak, limit):
        return record.but(status=Verdict.MEMORY_LIMIT)
    return record


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
        qp_file = scratch / "qp.npz"
        digest = save_qp(qp_file, case.qp, {"name": record.case}, recipe=True)
        record, solution = measured(
            worker,
            case.qp,
            record.but(qp=digest),
            {
                "qp": str(qp_file),
                "digest": content_digest(qp_file),
                "out": str(scratch / "point.npz"),
            },
            time_limit=inf,
            memory_limit=inf,
        )
    if solution is None or record.status is Verdict.DECLINED:
        return record, solution
    quantities, note = quantities_of(case, solution)
    bounds, objection = certified(case, solution)
    record = noted(record, note, objection).but(quantities=quantities, **bounds)
    return record, solution
