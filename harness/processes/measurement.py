"""Measurement of a solver in a worker process, and the verdict on its answer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from math import inf, isinf
from pathlib import Path
from typing import Any

from mortarbench.harness.errors import FaultError, InputError
from mortarbench.harness.files.mapped import content_digest
from mortarbench.harness.files.qpfile import save_qp
from mortarbench.harness.files.store import read_point
from mortarbench.harness.plugin import Case
from mortarbench.harness.processes.scratch import scratch_folder
from mortarbench.harness.processes.supervisor import Reply, WorkerProcess, out_of_memory
from mortarbench.harness.qp import QP
from mortarbench.harness.record import Record, Verdict
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify.measure import REMEMBERED_SPEEDUP
from mortarbench.harness.verify.verdicts import (
    claimed,
    judged,
    noted,
    results_of,
)

REMEMBERED_NOTE = (
    "the solver reuses answers of earlier solves: for a QP with another objective it "
    f"takes more than {REMEMBERED_SPEEDUP:g} times as long, or returns the same point"
)


def measure_and_judge(
    worker: WorkerProcess,
    whole: Callable[[], QP],
    record: Record,
    *,
    out: Path,
    qp_file: tuple[Path, str] | None = None,
    own_code_only: bool = False,
    time_limit: float,
    memory_limit: float = inf,
    **entries: Any,
) -> tuple[Record, Solution | None]:
    """Measure once with a worker process, and complete `record` with costs and verdict.

    If the worker ends in a repetition of a completed solve, the QP is solved and timed
    once in a new worker.

    whole : returns the QP; not called if ranks build the QP
    out : file to which the worker writes the point
    qp_file : file with the QP, and digest of its content; None if ranks build the QP,
        judge the answer, and compute its quantities and error bounds
    own_code_only : False if code of plug-ins may run on the ranks, so that new ranks
        judge the answer
    time_limit, memory_limit : limits in s and MiB
    entries : further entries of the request, see `harness.processes.worker`

    Returns
    -------
    the record, and the answer of the solver or None if the worker ended without one

    Raises
    ------
    FaultError
        If the measurement failed for a reason other than the solver: the worker could
        not be started or was killed before its solve, the disk was full, or a file was
        lost.

    """
    request = {"out": str(out), "tol": record.tol, **entries}
    if qp_file is None:
        request["case"] = case_entry(record)
        request["judged_at"] = record.judged_at if own_code_only else None
    else:
        request |= {"qp": str(qp_file[0]), "digest": qp_file[1]}
    if not isinf(memory_limit):
        request["memory_limit"] = memory_limit
    started = datetime.now(UTC).isoformat(timespec="milliseconds")
    try:
        out.unlink(missing_ok=True)
        ask = partial(worker.ask, time_limit=time_limit, memory_limit=memory_limit)
        reply, notes = ask(request), list[str]()
        if reply.in_repeats:
            notes = [f"solved only once, since a repeated solve ended: {reply.message}"]
            reply = ask({**request, "once": True})
        if reply.fault:
            raise FaultError(f"{record.solver} on {record.case}: {reply.message}")
        record = record.replace(
            started=started,
            message=reply.message,
            peak_mib=reply.peak_mib,
            threads=reply.threads,
            cpu=reply.cpu,
        )
        if qp_file is not None:
            qp = whole()
            record = record.replace(sizes=qp.sizes)
        elif reply.built is not None:
            record = record.replace(**reply.built)
        if reply.answer is None:
            return record.replace(status=reply.verdict), None
        solution = _solution(out, reply.answer)
    except (InputError, OSError) as e:  # a file is damaged, or the disk is full
        raise FaultError(f"{record.solver} on {record.case}: {e}") from None
    cost, more = _cost(reply)
    record = record.replace(**cost)
    if qp_file is not None:
        record = judged(record, qp, solution)
    else:
        known = (
            reply.answer
            if own_code_only
            else _judged_apart(worker, record, out, solution.status)
        )
        fields = dict(known["fields"])
        fields["status"] = Verdict(fields["status"])
        record = claimed(record, solution).replace(**fields)
        more += known["notes"]
    record = noted(record, reply.message, *notes, *more)
    return _check_memory(memory_limit, record), solution


def _judged_apart(
    worker: WorkerProcess, record: Record, point: Path, status: Status
) -> Mapping[str, Any]:
    """Judge a stored point on new ranks, which have not run the solver.

    Raises
    ------
    FaultError
        If the new ranks end without a verdict.

    """
    request = {
        "case": case_entry(record),
        "point": str(point),
        "claimed": status,
        "judged_at": record.judged_at,
    }
    with closing(worker.judge()) as judge:
        reply = judge.ask(request, time_limit=inf, memory_limit=inf)
    if reply.answer is None:
        raise FaultError(f"{record.case} could not be judged: {reply.message}")
    return reply.answer


def _solution(point: Path, answer: Mapping[str, Any]) -> Solution:
    reported = answer["reported"].items()
    return replace(
        read_point(point, Status(answer["claimed"])),
        **{k: answer[k] for k in ("iterations", "counts", "message")},
        reported={k: v for k, v in reported if v is not None},
    )


def case_entry(r: Record) -> dict[str, Any]:
    """Return the specification of a case in requests, see `harness.processes.cases`."""
    return {"family": r.family, "params": r.params, "form": r.form, "name": r.case}


def _cost(reply: Reply) -> tuple[dict[str, Any], list[str]]:
    """Return the cost of a measurement as fields of its record, and notes.

    Times that exceed the time on the parent's clock are replaced by the latter.
    """
    assert reply.answer is not None
    cost, worked = dict(reply.answer["cost"]), reply.answer["worked_seconds"]
    elapsed, notes = reply.elapsed_seconds, list[str]()
    if elapsed is not None and cost and not 0 <= worked <= elapsed:
        mean = elapsed / reply.answer["solves"]
        cost |= {"prepare_seconds": None, "solve_seconds": None, "total_seconds": mean}
        notes.append(
            f"the worker reported {worked:.3g} s of work, but was done after "
            f"{elapsed:.3g} s by the parent's clock; the parent's time is recorded"
        )
    if cost.get("remembered"):
        notes.append(REMEMBERED_NOTE)
    # the worker measures only the memory of its own process
    if reply.built is not None:
        cost["peak_mib"] = reply.peak_mib
    return cost, notes


def _check_memory(limit: float, record: Record) -> Record:
    """Set the verdict MEMORY_LIMIT if the solver exceeded the limit or lacked memory.

    limit : memory limit, in MiB
    """
    if record.status is Verdict.DECLINED:
        return record
    peak = record.peak_mib
    if peak is not None and peak > limit:
        message = f"reached {peak:.0f} MiB, above the limit of {limit:g} MiB"
        return noted(record.replace(status=Verdict.MEMORY_LIMIT), message)
    succeeded = record.status.is_verified or record.status is Verdict.INACCURATE
    if not succeeded and out_of_memory(record.message, peak, limit):
        return record.replace(status=Verdict.MEMORY_LIMIT)
    return record


def measure_once(
    worker: WorkerProcess,
    case: Callable[[], Case],
    record: Record,
    *,
    own_code_only: bool = False,
    time_limit: float = inf,
) -> tuple[Record, Solution | None]:
    """Measure once, judge the answer, and compute quantities and bounds.

    case : returns the case; the first call builds it. Not called if ranks build it
    own_code_only : see `measure_and_judge`
    time_limit : limit of the solve, in s

    Raises
    ------
    FaultError
        If the measurement fails twice for a reason other than the solver.

    """
    with scratch_folder() as scratch:
        path, qp_file = scratch / "qp.npz", None
        if record.ranks == 1:
            saved = save_qp(path, case().qp, {"name": record.case}, serialised=True)
            record = record.replace(qp=case().digest or saved)
            qp_file = path, content_digest(path)
        once = partial(
            measure_and_judge,
            worker,
            lambda: case().qp,
            record,
            out=scratch / "point.npz",
            qp_file=qp_file,
            own_code_only=own_code_only,
            time_limit=time_limit,
        )
        try:
            record, solution = once()
        except FaultError:
            record, solution = once()
    declined = record.status is Verdict.DECLINED
    if solution is None or declined or record.ranks > 1:
        return record, solution
    results, notes = results_of(case(), solution)
    return noted(record.replace(**results), *notes), solution
