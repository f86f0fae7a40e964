"""Where blocks are carried out: the processes of a run on one machine."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from math import inf
from pathlib import Path
from typing import Any

from mortarbench.harness.errors import FaultError
from mortarbench.harness.files.durable import refuse_full_disk, report_full_disk
from mortarbench.harness.files.qpfile import load_qp
from mortarbench.harness.files.store import point_arrays, read_arrays, read_point
from mortarbench.harness.operators import NO_MAKERS, Maker
from mortarbench.harness.processes.case_folder import Entry, entry
from mortarbench.harness.processes.measurement import case_request, measured
from mortarbench.harness.processes.protocol import Source
from mortarbench.harness.processes.supervisor import WorkerProcess
from mortarbench.harness.qp import QP
from mortarbench.harness.record import Record, Verdict
from mortarbench.harness.registry import COPIES
from mortarbench.harness.results.work_unit import (
    Commands,
    Engine,
    Outcome,
    Result,
    Unbuilt,
    Unmade,
    WorkUnit,
)
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify.measure import SAMPLE_SECONDS
from mortarbench.harness.verify.optimum import Optimum, proven_optimum
from mortarbench.harness.verify.verdicts import has_point, noted

_MOST_PROVEN = 1000  #: small QPs whose optima are kept
LOOSEST = 1e-2  #: tolerance of a step, however far its QP is from the fixed point


@dataclass(eq=False)
class Executor:
    """Carries out blocks one after the other, with one worker process per solver.

    scratch : for files that last as long as the executor, of this executor alone
    cases : folder of built cases, see `harness.processes.case_folder`; executors
        may share it
    operators : what puts an operator P together, see `harness.operators`
    """

    commands: Commands
    scratch: Path
    cases: Path
    operators: Mapping[str, Maker] = field(default_factory=lambda: NO_MAKERS)
    _workers: dict[str, WorkerProcess] = field(default_factory=dict)
    _number: int = -1  # of the last block
    _entries: tuple[Entry, ...] = ()  # of that, once they are built
    _end: str = ""  # why there are fewer than its sequence asked for
    _loaded: dict[str, QP] = field(default_factory=dict)  # theirs, by digest
    #: of small QPs, by digest
    _optima: dict[str, Optimum | None] = field(default_factory=dict)
    #: whether ranks emit the QP, by case
    _shared: dict[str, bool] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._case_worker = WorkerProcess(
            self.commands.case_worker, self.scratch / "case-worker.log"
        )

    def close(self) -> None:
        """End the processes."""
        for process in (*self._workers.values(), self._case_worker):
            process.close()

    def execute(self, block: WorkUnit) -> Iterator[Outcome]:
        """Measure a block; each result comes as soon as it is there.

        Raises
        ------
        InputError
            When the disk is full.

        """
        with report_full_disk(self.scratch):
            try:
                if block.number != self._number:  # else it goes on with its next turns
                    self._number, self._entries = block.number, ()
                for turn in block.turns:
                    yield from self._turn(block, turn)
            except _UnbuiltError as e:
                yield Unbuilt(block=block, reason=e.reason, trace=e.trace)

    def _turn(self, block: WorkUnit, turn: tuple[Record, ...]) -> Iterator[Outcome]:
        """Measure one solver; after a fault that is not its own, once more.

        Of a sequence all steps are driven again, since what the solver carried is lost;
        none is given back twice.
        """
        made: set[str] = set()
        for tried_again in (True, False):
            try:
                for result in self._results(block, turn):
                    if result.record.run_id not in made:
                        made.add(result.record.run_id)
                        yield result
                return
            except (FaultError, OSError) as e:
                reason = " ".join(str(e).split())
                if not isinstance(e, FaultError):
                    reason = f"{type(e).__name__}: {reason}"
                refuse_full_disk(self.scratch, reason)
            label = turn[0].solver
            self._entries = ()
            with suppress(FileNotFoundError):  # the whole result folder has gone
                self.scratch.mkdir(exist_ok=True)
            self._worker(label).close()
            missing = [record for record in turn if record.run_id not in made]
            for record in missing[: 1 if tried_again else None]:
                yield Unmade(record=record, reason=reason, tried_again=tried_again)

    def _results(self, block: WorkUnit, turn: tuple[Record, ...]) -> Iterator[Result]:
        """Measure one solver once on each case.

        Ranks that make a QP judge its answer, too, where no code but ours runs in them.
        The case is built then only where they cannot tell something of it.

        Raises
        ------
        FaultError, OSError
            When something else than the solver failed.

        """
        source = self._source(turn[0])
        if source is not Source.RANKS:
            self._build(block, turn)
        there = turn if source is Source.RANKS else turn[: len(self._entries)]
        for step, record in enumerate(there):
            request, record = self._request(block, record, step, source)

            def whole(step: int = step) -> QP:
                self._build(block, turn)
                return self._qp(self._entries[step])

            def proven(qp: QP, step: int = step) -> Optimum | None:
                return self._optimum(self._entries[step], qp)

            record, solution, is_undescribed = measured(
                self._worker(turn[0].solver), whole, record, request,
                time_limit=block.time_limit, memory_limit=block.memory_limit,
                prove=proven,
            )  # fmt: skip
            if record.verdict in (Verdict.CRASHED, Verdict.FAILED):
                refuse_full_disk(self.scratch, "")  # whatever it died of
            is_pointless = solution is None or not has_point(solution)
            if solution is None or is_pointless or is_undescribed:
                yield self._described(block, record, solution)
            else:
                yield Result(record=record, point=point_arrays(solution))
            stopped = is_pointless and record.verdict is not Verdict.DECLINED
            if block.is_sequence and stopped:  # what it carried is lost
                yield from _broken(there[step + 1 :], record)
                break
        for record in turn[len(there) :]:
            declined = record.replace(verdict=Verdict.DECLINED, message=self._end)
            yield Result(record=declined)

    def _request(
        self, block: WorkUnit, record: Record, step: int, source: Source
    ) -> tuple[dict[str, Any], Record]:
        """Ask for a measurement, and fill in what is known of its case before."""
        request = {
            "out": str(self._point),
            "source": source,
            "sample_seconds": 0.0 if block.is_sequence else SAMPLE_SECONDS,
            **({"step": step} if block.is_sequence else {}),
            **({"tightens": True} if record.tighten else {}),
        }
        if source.is_shared:
            request |= case_request(record)
        if source is Source.RANKS:
            return request, record
        at = self._entries[step]
        if not source.is_shared:
            request |= {"qp": str(at.qp), "digest": at.digest}
        keys = ("qp", "build_seconds", "dualise_seconds")
        known = {key: at.meta.get(key) for key in keys}
        return request, record.replace(**known, step_tol=_step_tol(record, at))

    def _source(self, record: Record) -> Source:
        """Return where the QP of a record comes from."""
        if record.ranks == 1 or record.role == COPIES or record.mode != "cold":
            return Source.FILE
        if record.case not in self._shared:
            request = {"shared": _case(record)}
            reply = self._case_worker.ask(request, time_limit=inf, memory_limit=inf)
            if reply.answer is None:
                raise FaultError(reply.message)
            self._shared[record.case] = reply.answer["shared"]
        if not self._shared[record.case]:
            return Source.FILE
        return Source.RANKS if self.commands.own_code_only else Source.SHARES

    def _build(self, block: WorkUnit, turn: tuple[Record, ...]) -> None:
        """Build the cases of a block, of a sequence as many as there are; once."""
        if self._entries:
            return
        entries: list[Entry] = []
        self._end = ""
        for record in turn:
            try:
                entries.append(self._entry(record, block))
            except _UnbuiltError as e:
                if not entries or not e.past_end:
                    raise
                self._end = e.reason
                break
        self._entries = tuple(entries)
        self._loaded = {e.digest: self._qp(e) for e in entries}

    def _described(
        self, block: WorkUnit, record: Record, solution: Solution | None
    ) -> Result:
        """Add what the point means, which the case worker knows."""
        if solution is None or not has_point(solution):
            return Result(record=record)
        first = record.verdict is Verdict.VERIFIED and record.repeat == 0
        fields = self.scratch / "fields.npz"
        fields.unlink(missing_ok=True)
        request = {
            "describe": _case(record),
            "point": str(self._point),
            "fields": str(fields) if first else None,
        }
        notes: list[str]
        try:
            answer = self._ask_case_worker(request, block)
            notes = answer["notes"]
            record = record.replace(
                quantities=answer["quantities"],
                recover_seconds=answer["seconds"],
                **answer["bounds"],
            )
        except _UnbuiltError as e:
            notes = [f"no quantities: {e.reason}"]
        stored = read_arrays(fields, ()) if fields.exists() else None
        return Result(
            record=noted(record, *notes), point=point_arrays(solution), fields=stored
        )

    def _entry(self, record: Record, block: WorkUnit) -> Entry:
        def make(path: Path) -> Mapping[str, Any]:
            request = {"build": _case(record), "qp": str(path)}
            meta: Mapping[str, Any] = self._ask_case_worker(request, block)["meta"]
            return meta

        r = record
        return entry(self.cases, [r.family, r.params, r.form, r.environment], make)

    def _ask_case_worker(
        self, request: Mapping[str, Any], block: WorkUnit
    ) -> Mapping[str, Any]:
        for _ in range(2):  # it may have died of something else
            reply = self._case_worker.ask(
                {**request, "keep": len(block.cases)}, time_limit=inf, memory_limit=inf
            )
            if reply.answer is not None:
                break
        else:
            refuse_full_disk(self.scratch, reply.message)
            if reply.fault:
                raise FaultError(reply.message)
            case = block.turns[0][0].case
            raise _UnbuiltError(f"{case} could not be built: {reply.message}", "")
        if "unbuilt" in reply.answer:
            refuse_full_disk(self.scratch, reply.answer["unbuilt"])
            answer = reply.answer
            raise _UnbuiltError(
                answer["unbuilt"], answer["trace"], past_end=answer["past_end"]
            )
        return reply.answer

    def _optimum(self, at: Entry, qp: QP) -> Optimum | None:
        """Prove the optimum of the QP of an entry, once."""
        if at.digest not in self._optima:
            found = proven_optimum(qp, partial(self._reference, at))
            while len(self._optima) >= _MOST_PROVEN:
                del self._optima[next(iter(self._optima))]
            self._optima[at.digest] = found
        return self._optima[at.digest]

    def _reference(self, at: Entry, qp: QP) -> Solution:
        """Have the case worker solve the QP of an entry by the reference.

        Raises
        ------
        ArithmeticError
            When it found no solution.
        FaultError
            When it died, or a file between us failed.

        """
        point = self.scratch / "reference.npz"
        request = {"solve": str(at.qp), "point": str(point)}
        reply = self._case_worker.ask(request, time_limit=inf, memory_limit=inf)
        if reply.answer is None:
            raise FaultError(f"the reference solve failed: {reply.message}")
        if not reply.answer["found"]:
            raise ArithmeticError("the reference solve found no solution")
        return read_point(point, Status.SOLVED)

    def _worker(self, label: str) -> WorkerProcess:
        if label not in self._workers:
            log = self.scratch / f"worker-{len(self._workers)}.log"
            self._workers[label] = WorkerProcess(self.commands.solvers[label], log)
        return self._workers[label]

    def _qp(self, at: Entry) -> QP:
        if at.digest not in self._loaded:
            self._loaded[at.digest] = load_qp(at.qp, operators=self.operators)[0]
        return self._loaded[at.digest]

    @property
    def _point(self) -> Path:
        return self.scratch / "point.npz"


@contextmanager
def one_by_one(
    commands: Commands,
    scratch: Path,
    cases: Path,
    *,
    operators: Mapping[str, Maker] = NO_MAKERS,
) -> Iterator[Engine]:
    """Open the engine of one machine: it makes a block when the last one is done."""
    with closing(Executor(commands, scratch, cases, operators)) as executor:
        yield lambda blocks: chain.from_iterable(map(executor.execute, blocks))


def _step_tol(record: Record, at: Entry) -> float | None:
    """Find what a step is worth solving to, where that is looser than what is asked.

    The QP is as far from the fixed point as `harness.plugin.Case.unsettled` says, and
    a part θ of that is enough (Eisenstat and Walker 1996, SIAM J. Sci. Comput. 17). The
    last QP of a fixed point is solved to the tolerance.
    """
    worth = min(LOOSEST, record.tighten * float(at.meta.get("unsettled", 0.0)))
    return worth if worth > record.tol else None


def _broken(rest: tuple[Record, ...], end: Record) -> Iterator[Result]:
    """Give the steps that a sequence did not come to, because of how one ended."""
    for record in rest:
        reason = f"the sequence ended at {end.case}: {end.message}"
        yield Result(record=record.replace(verdict=end.verdict, message=reason))


class _UnbuiltError(Exception):
    def __init__(self, reason: str, trace: str, *, past_end: bool = False) -> None:
        super().__init__(reason)
        self.reason = reason
        self.trace = trace
        self.past_end = past_end


def _case(r: Record) -> dict[str, Any]:
    """Ask for the case of a record, as `harness.processes.case_worker` is asked."""
    return {"family": r.family, "params": r.params, "form": r.form, "name": r.case}
