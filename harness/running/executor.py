"""Executor of blocks, which manages the processes of a run on one machine."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

from mortarbench.harness.errors import FaultError, described
from mortarbench.harness.files.durable import refuse_full_disk, report_full_disk
from mortarbench.harness.files.mapped import content_digest
from mortarbench.harness.files.qpfile import load_qp
from mortarbench.harness.files.store import point_arrays, read_arrays
from mortarbench.harness.operators import NO_MAKERS, Maker
from mortarbench.harness.processes.measurement import case_entry, measure_and_judge
from mortarbench.harness.processes.supervisor import WorkerProcess
from mortarbench.harness.qp import QP
from mortarbench.harness.record import Record, Verdict
from mortarbench.harness.results.work_unit import (
    BuildFailure,
    Commands,
    MeasurementFault,
    Outcome,
    Result,
    WorkUnit,
)
from mortarbench.harness.solution import Solution
from mortarbench.harness.verify.verdicts import has_point, noted


class BuiltCase(NamedTuple):
    """Case that the case worker has built."""

    #: file that contains the QP (`harness.files.qpfile`), and digest of its content
    file: tuple[Path, str]
    meta: Mapping[str, Any]  #: fields of records, see `harness.processes.cases`
    qp: QP


@dataclass(eq=False)
class Executor:
    """Sequential executor of blocks, with one worker process per solver.

    scratch : folder of temporary files that only this executor uses
    operators : makers of operators P by name, see `harness.operators`
    """

    commands: Commands
    scratch: Path
    operators: Mapping[str, Maker] = field(default_factory=lambda: NO_MAKERS)
    _workers: dict[str, WorkerProcess] = field(default_factory=dict)
    _names: tuple[str, ...] = ()  # names of the cases of the last block
    _entries: tuple[BuiltCase, ...] = ()  # those cases, once they are built
    # reason why the sequence has fewer cases than requested steps; else empty
    _end_reason: str = ""

    def __post_init__(self) -> None:
        self._point = self.scratch / "point.npz"
        self._case_worker = WorkerProcess(
            self.commands.case_worker, self.scratch / "case-worker.log"
        )

    def close(self) -> None:
        """End the workers and the case worker."""
        for process in (*self._workers.values(), self._case_worker):
            process.close()

    def execute(self, block: WorkUnit) -> Iterator[Outcome]:
        """Measure a block, and yield each outcome as soon as it is available.

        Raises
        ------
        InputError
            If the disk is full.

        """
        with report_full_disk(self.scratch):
            try:
                if self._names != block.cases:
                    self._names, self._entries = block.cases, ()
                for turn in block.turns:
                    yield from self._turn(block, turn)
            except _BuildError as e:
                yield BuildFailure(block=block, reason=e.reason)

    def _turn(self, block: WorkUnit, turn: tuple[Record, ...]) -> Iterator[Outcome]:
        """Measure one solver; retry once after a fault that the solver did not cause.

        For a sequence, all steps are repeated, because the data that the solver carries
        from step to step are lost. No result is yielded twice.
        """
        measured: set[str] = set()  # run IDs of measurements with a result
        for _ in range(2):
            try:
                for result in self._results(block, turn):
                    if result.record.run_id not in measured:
                        measured.add(result.record.run_id)
                        yield result
                return
            except (FaultError, OSError) as e:
                reason = str(e) if isinstance(e, FaultError) else described(e)
                refuse_full_disk(self.scratch, reason)
            label = turn[0].solver
            # build again, since a lost or damaged file may be the cause
            self._entries = ()
            with suppress(FileNotFoundError):  # the entire result folder was deleted
                self.scratch.mkdir(exist_ok=True)
            self._worker(label).close()
        for record in turn:
            if record.run_id not in measured:
                yield MeasurementFault(record=record, reason=reason)

    def _results(self, block: WorkUnit, turn: tuple[Record, ...]) -> Iterator[Result]:
        """Measure one solver once on each case.

        The case is built first, unless the worker itself builds and judges.

        Raises
        ------
        FaultError, OSError
            If the harness or the machine failed.

        """
        is_shared = turn[0].ranks > 1
        if not is_shared:
            self._build(turn)
        count = len(turn) if is_shared else len(self._entries)
        ended: Record | None = None
        for step, record in enumerate(turn):
            reason = ""
            if step >= count:
                status, reason = Verdict.DECLINED, self._end_reason
            elif ended is not None:
                status = ended.status
                reason = f"the sequence ended at {ended.case}: {ended.message}"
            if reason:
                yield Result(record=record.replace(status=status, message=reason))
                continue
            result = self._measure(block, turn, step)
            # a failed step loses the solver's data for later steps
            failed = result.record.status is not Verdict.DECLINED
            if block.is_sequence and result.point is None and failed:
                ended = result.record
            yield result
        if block.is_sequence and is_shared:
            self._worker(turn[0].solver).close()  # it remains between steps only

    def _measure(self, block: WorkUnit, turn: tuple[Record, ...], step: int) -> Result:
        """Measure one solver on one case, and evaluate its answer."""
        record, qp_file = turn[step], None
        entries: dict[str, Any] = {"step": step} if block.is_sequence else {}
        if len(turn) > 1:  # steps, whose times must not depend on the reuse of results
            entries["once"] = True
        if record.ranks == 1:
            built = self._entries[step]
            record, qp_file = record.replace(**built.meta), built.file
        record, solution = measure_and_judge(
            self._worker(record.solver),
            lambda: self._entries[step].qp,
            record,
            out=self._point,
            qp_file=qp_file,
            own_code_only=self.commands.own_code_only,
            time_limit=block.time_limit,
            memory_limit=block.memory_limit,
            **entries,
        )
        if record.status in (Verdict.CRASHED, Verdict.FAILED):
            refuse_full_disk(self.scratch, "")  # a full disk may be the cause
        if solution is None or not has_point(solution):
            return Result(record=record)
        if record.ranks == 1:
            return self._describe(record, solution)
        return Result(record=record, point=point_arrays(solution))

    def _build(self, turn: tuple[Record, ...]) -> None:
        """Build the cases of the current block, unless they are already built.

        If a sequence ends before the last step of `turn`, fewer cases are built.
        """
        if self._entries:
            return
        entries: list[BuiltCase] = []
        self._end_reason = ""
        for step, record in enumerate(turn):
            path = self.scratch / f"qp{step}"
            request = {"build": case_entry(record), "qp": str(path)}
            try:
                meta = self._ask_case_worker(request)["meta"]
                qp, _ = load_qp(path, operators=self.operators)
                entries.append(BuiltCase((path, content_digest(path)), meta, qp))
            except _BuildError as e:
                if not entries or not e.past_end:
                    raise
                self._end_reason = e.reason
                break
        self._entries = tuple(entries)

    def _describe(self, record: Record, solution: Solution) -> Result:
        """Add physical quantities and error bounds, computed by the case worker."""
        first = record.status is Verdict.VERIFIED and record.repeat == 0
        fields = self.scratch / "fields.npz"
        fields.unlink(missing_ok=True)
        request = {
            "describe": case_entry(record),
            "point": str(self._point),
            "fields": str(fields) if first else None,
        }
        notes: list[str]
        try:
            answer = self._ask_case_worker(request)
            record, notes = record.replace(**answer["fields"]), answer["notes"]
        except _BuildError as e:
            notes = [f"no quantities: {e.reason}"]
        stored = read_arrays(fields, ()) if fields.exists() else None
        return Result(
            record=noted(record, *notes), point=point_arrays(solution), fields=stored
        )

    def _ask_case_worker(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """Send a request to build or to evaluate a case, and return the answer.

        Raises
        ------
        _BuildError
            If the case cannot be built or evaluated.
        FaultError
            If the harness or the machine failed.

        """
        # retry once: the process may have been killed from outside, or an earlier case
        # may have crashed it
        for _ in range(2):
            reply = self._case_worker.ask(
                {**request, "keep": len(self._names)},
                time_limit=inf,
                memory_limit=inf,
            )
            if reply.answer is not None:
                break
        else:
            refuse_full_disk(self.scratch, reply.message)
            if reply.fault:
                raise FaultError(reply.message)
            what = "built" if "build" in request else "evaluated"
            case = request.get("build") or request["describe"]
            reason = f"{case['name']} could not be {what}: {reply.message}"
            raise _BuildError(reason)
        if "unbuilt" in reply.answer:
            refuse_full_disk(self.scratch, reply.answer["unbuilt"])
            raise _BuildError(reply.answer["unbuilt"], reply.answer["past_end"])
        return reply.answer

    def _worker(self, label: str) -> WorkerProcess:
        if label not in self._workers:
            log = self.scratch / f"worker-{len(self._workers)}.log"
            self._workers[label] = WorkerProcess(self.commands.solvers[label], log)
        return self._workers[label]


def execute(
    blocks: Iterator[WorkUnit],
    commands: Commands,
    scratch: Path,
    *,
    operators: Mapping[str, Maker] = NO_MAKERS,
) -> Generator[Outcome]:
    """Execute blocks one after the other on this machine, see `Executor`."""
    with closing(Executor(commands, scratch, operators)) as executor:
        for block in blocks:
            yield from executor.execute(block)


@dataclass(eq=False)
class _BuildError(Exception):
    reason: str
    past_end: bool = False
