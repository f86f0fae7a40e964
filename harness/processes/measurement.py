"""One measurement by a worker process, judged: what `run` and `solve` share."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from datetime import UTC, datetime
from functools import partial
from math import inf, isinf, nan
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any, NamedTuple

from mortarbench.harness.errors import FaultError, InputError
from mortarbench.harness.files.qpfile import save_qp
from mortarbench.harness.files.store import read_point
from mortarbench.harness.plugin import Case, Reference
from mortarbench.harness.processes.case_folder import content_digest
from mortarbench.harness.processes.forking import Serve
from mortarbench.harness.processes.protocol import Source, source_of
from mortarbench.harness.processes.ranks import without_content
from mortarbench.harness.processes.supervisor import Reply, WorkerProcess, out_of_memory
from mortarbench.harness.qp import QP
from mortarbench.harness.record import (
    MEASURED,
    Measurement,
    Record,
    Verdict,
    journal_name,
)
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify.kkt import Residuals
from mortarbench.harness.verify.optimum import Proves, proves
from mortarbench.harness.verify.verdicts import (
    certified,
    has_point,
    judged,
    noted,
    quantities_of,
)

OWN_SECONDS = 0.005  #: of our own work while a worker's clock is stopped
OWN_SECONDS_PER_REPEAT = (
    3e-4  #: 0.12 ms on a busy machine, so that none is accused of it
)
FAR_LESS = 20.0  #: a repeat that is so many times faster …
LEAST_GAIN_SECONDS = 1e-3  #: … and faster by that is suspicious, within a sample
LEAST_GAIN_BETWEEN_SECONDS = 5e-3  #: and between measurements

_NO_POINT = dict.fromkeys(("objective", *Residuals._fields), nan)
_SCRATCH, _LOCK = "mortarbench-scratch-", "in-use"


class Measured(NamedTuple):
    """One measurement, judged."""

    record: Record
    solution: Solution | None  #: None where the worker ended
    #: whether quantities or bounds are lacking, though there is a point: ranks that
    #: evaluate an answer fill in what they can
    is_undescribed: bool = True


def measured(
    worker: WorkerProcess,
    whole: Callable[[], QP],
    record: Record,
    request: Mapping[str, Any],
    *,
    time_limit: float,
    memory_limit: float,
    prove: Proves,
) -> Measured:
    """Fill in `record` by one measurement.

    whole : gives the QP. Where ranks emit it themselves and evaluate the answer, it is
        asked for only if they cannot
    request : to the worker, see `harness.processes.worker`; less what stands in the
        record. The worker writes the point to the file ``out``
    time_limit, memory_limit : s and MiB
    prove : finds the optimum where residuals cannot decide, see
        `harness.verify.optimum`

    Raises
    ------
    FaultError
        When the measurement failed for a reason that is not the solver's: a worker that
        was not started or was killed before its solve, a full disk, a lost file.

    """
    request = {**request, "tol": record.asked_tol}
    if not isinf(memory_limit):
        request["memory_limit"] = memory_limit
    started = datetime.now(UTC).isoformat(timespec="milliseconds")
    out = Path(request["out"])
    try:
        out.unlink(missing_ok=True)
        reply = worker.ask(request, time_limit=time_limit, memory_limit=memory_limit)
        if reply.fault:
            raise FaultError(f"{record.solver} on {record.case}: {reply.message}")
        record = record.replace(
            started=started,
            message=reply.message,
            peak_mib=reply.peak_mib,
            threads=reply.threads,
            cpu=reply.cpu,
        )
        if source_of(request) is Source.RANKS:
            qp, record = _as_told(reply.emitted, record)
        else:
            qp = whole()
            record = record.replace(sizes=qp.sizes)
        if reply.answer is None:
            return Measured(record.replace(verdict=reply.verdict), None)
        solution = replace(
            read_point(out, Status(reply.answer["claimed"])),
            iterations=reply.answer["iterations"],
            counts=reply.answer["counts"],
            reported={
                k: v for k, v in reply.answer["reported"].items() if v is not None
            },
            message=reply.answer["message"],
        )
    except InputError as e:
        raise FaultError(f"{record.solver} on {record.case}: {e}") from None
    except OSError as e:
        what = f"{e.filename or out}: {e.strerror or e}"
        raise FaultError(f"{record.solver} on {record.case}: {what}") from None
    record, *notes = _timed(reply, record, worker.first_seconds)
    sizes, by_ranks = record.sizes, source_of(request) is Source.RANKS
    is_pointless = by_ranks and not has_point(solution)
    found = reply.answer["evaluated"] if by_ranks else None
    notes += found["notes"] if found is not None else []
    if found is not None and found["values"] is not None:
        record = judged(record, qp, solution, values=found["values"]).replace(
            quantities=found["quantities"] or {},
            recover_seconds=found["recover_seconds"],
            **(found["bounds"] or {}),
        )
    elif is_pointless:
        record = judged(record, qp, solution, values=_NO_POINT)
    else:
        record = judged(record, whole() if by_ranks else qp, solution, prove)
    record = _within(memory_limit, noted(record, reply.message, *notes)).replace(
        sizes=sizes, **{k: _as_tuples(v) for k, v in reply.answer["record"].items()}
    )
    lacks = found is None or None in (found["quantities"], found["bounds"])
    return Measured(record, solution, lacks and not is_pointless)


def _as_tuples(data: Any) -> Any:
    """Undo what JSON makes of tuples in a table."""
    if isinstance(data, dict):
        return {key: _as_tuples(value) for key, value in data.items()}
    return tuple(data) if isinstance(data, list) else data


def _timed(
    reply: Reply, record: Record, first_seconds: dict[Hashable, float]
) -> tuple[Record, *tuple[str, ...]]:
    """Fill in what the measurement cost; with notes on what cannot be believed."""
    assert reply.answer is not None
    cost, *notes = _believed(reply)
    if record.ranks > 1:  # the worker knows its own memory, we that of all ranks
        cost = replace(cost, peak_mib=reply.peak_mib)
    if not notes:
        first, what = reply.answer["first_seconds"], (record.qp, record.asked_tol)
        notes = _cached(cost, first, first_seconds, what)
    return record.replace(**asdict(cost)), *notes


def case_request(record: Record) -> dict[str, Any]:
    """Name the case of a record to ranks that make its QP."""
    case = {
        "family": record.family, "params": dict(record.params), "form": record.form
    }  # fmt: skip
    return {"case": case}


def _as_told(emitted: Mapping[str, Any] | None, record: Record) -> tuple[QP, Record]:
    """Take what ranks tell of a QP that they have emitted; nothing, if they did not."""
    if emitted is None or not emitted["sizes"]:
        return without_content(0, 0), record
    sizes = emitted["sizes"]
    return without_content(sizes["variables"], sizes["equalities"]), record.replace(
        sizes=sizes, qp=emitted["digest"], build_seconds=emitted["build_seconds"]
    )


def _believed(reply: Reply) -> tuple[Measurement, *tuple[str, ...]]:
    """Return the worker's times if the parent's clock allows them, else the parent's.

    They may sum to no more time than passed between request and end, and to no less
    than the CPU time that the kernel counted, but for our own work meanwhile.
    """
    answer, clock = reply.answer, reply.clock
    assert answer is not None
    told = Measurement(**{name: answer[journal_name(name)] for name in MEASURED})
    if clock is None or told.total_seconds is None:
        return (told,)
    inner, first = told.inner_loops, answer["first_seconds"]
    times = inner + (first is not None)
    reported = (first or 0.0) + inner * told.total_seconds
    least = clock.least - OWN_SECONDS - inner * OWN_SECONDS_PER_REPEAT
    if max(0.0, least) <= reported <= clock.most:
        return (told,)
    seen = clock.seen / times
    ours = replace(told, prepare_seconds=None, solve_seconds=None, total_seconds=seen)
    return ours, (
        f"the worker told of {reported:.3g} s of work; by our clock it was busy for "
        f"{clock.least:.3g} s, and done after {clock.seen:.3g} s: the time is ours"
    )


def _cached(
    m: Measurement,
    first: float | None,
    first_seconds: dict[Hashable, float],
    what: Hashable,
) -> list[str]:
    """Say so where a repeat took far less than the first time.

    first : what the first time took, where there were others
    first_seconds : of each QP and tolerance, in the first measurement; `what` is added
    """
    if m.total_seconds is None:
        return []
    first = first or m.total_seconds
    before = first_seconds.setdefault(what, first)
    compared = [
        (first, m.total_seconds, LEAST_GAIN_SECONDS, "solves"),
        (before, first, LEAST_GAIN_BETWEEN_SECONDS, "measurements"),
    ]
    return [
        f"took {slow:.3g} s the first time and {fast:.3g} s later: something is kept "
        f"between {these}, or was loaded at the first"
        for slow, fast, gain, these in compared
        if slow > FAR_LESS * fast and slow - fast > gain
    ]


def _within(limit: float, record: Record) -> Record:
    """Say so where an answer went beyond the memory limit, or failed because of it."""
    if record.verdict is Verdict.DECLINED:
        return record
    peak = record.peak_mib
    if peak is not None and peak > limit:
        message = f"reached {peak:.0f} MiB, above the limit of {limit:g} MiB"
        return noted(record.replace(verdict=Verdict.MEMORY_LIMIT), message)
    succeeded = record.verdict.is_verified or record.verdict is Verdict.INACCURATE
    if not succeeded and out_of_memory(record.message, peak, limit):
        return record.replace(verdict=Verdict.MEMORY_LIMIT)
    return record


@contextmanager
def single_worker(
    command: list[str], serve: Serve | None = None
) -> Iterator[WorkerProcess]:
    """Give a worker for one measurement, which ends with the context.

    command : starts the worker; two file descriptors are appended to it
    serve : what a fork of this process does in its place, if that is safe; now, before
        anything is in memory that it has no use for
    """
    with scratch_folder() as scratch:
        worker = WorkerProcess(command, scratch / "worker.log")
        try:
            if serve is not None:
                worker.fork(serve)
            yield worker
        finally:
            worker.close()


def measured_once(
    worker: WorkerProcess,
    case: Callable[[], Case],
    record: Record,
    reference: Reference,
    *,
    source: Source = Source.FILE,
) -> tuple[Record, Solution | None]:
    """Do as `measured`, without limits, and say what the point means.

    case : gives the case, built when it is first asked for
    reference : solves the QP where residuals cannot decide
    source : of the QP; ranks judge answers only where no code but ours runs in them,
        and what is asked of the case is then what they cannot tell

    Raises
    ------
    FaultError
        As `measured`, after a second try.

    """
    with scratch_folder() as scratch:
        request: dict[str, Any] = {"out": str(scratch / "point.npz"), "source": source}
        if source.is_shared:
            request |= case_request(record)
        if source is not Source.RANKS:
            qp_file = scratch / "qp.npz"
            meta = {"name": record.case}
            digest = save_qp(qp_file, case().qp, meta, serialised=True)
            record = record.replace(qp=digest)
            if not source.is_shared:
                request |= {"qp": str(qp_file), "digest": content_digest(qp_file)}
        once = partial(
            measured, worker, lambda: case().qp, record, request,
            time_limit=inf, memory_limit=inf, prove=proves(reference),
        )  # fmt: skip
        try:
            record, solution, is_undescribed = once()
        except FaultError:
            record, solution, is_undescribed = once()
    declined = record.verdict is Verdict.DECLINED
    if solution is None or declined or not is_undescribed:
        return record, solution
    if not record.quantities:
        quantities, note = quantities_of(case(), solution)
        record = noted(record, note).replace(quantities=quantities)
    if record.certify_seconds is None:
        bounds, objection = certified(case(), solution)
        record = noted(record, objection).replace(**bounds)
    return record, solution


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Make a folder for temporary files, which goes when it is left.

    Those that a killed process could not remove go first: who uses one holds a lock in
    it, which ends with the process.
    """
    for stale in Path(gettempdir()).glob(f"{_SCRATCH}*"):
        with suppress(OSError):
            if stale.lstat().st_uid == os.getuid() and not stale.is_symlink():
                lock = os.open(stale / _LOCK, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(stale)
                finally:
                    os.close(lock)
    is_ours = False
    while not is_ours:  # until we lock it, somebody may take it for stale
        with TemporaryDirectory(prefix=_SCRATCH) as name:
            path = Path(name) / _LOCK
            lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX)
                is_ours = path.exists()
                if is_ours:
                    yield Path(name)
            finally:
                os.close(lock)
