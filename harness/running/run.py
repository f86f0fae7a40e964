"""A suite, measured: the schedule, resumption, and one journal line per measurement.

This process decides what is measured, and alone writes the result folder; an engine
carries out the blocks. So a run is the same on one machine and on many.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from secrets import token_hex
from typing import Any

from mortarbench.harness.errors import InputError, shown
from mortarbench.harness.files.copies import keep_copies, refuse_own_copies
from mortarbench.harness.files.durable import report_full_disk
from mortarbench.harness.files.lines import Lines
from mortarbench.harness.files.store import save
from mortarbench.harness.plugin import Solver
from mortarbench.harness.processes.termination import TerminatedError, ended_by_signals
from mortarbench.harness.record import Record, finite
from mortarbench.harness.registry import SolverSpec, options_of
from mortarbench.harness.results.faults import FAULTS, Fault
from mortarbench.harness.results.folder import (
    REMEDY,
    Held,
    claim,
    describe,
    locked,
    refuse_foreign,
    refuse_other,
    scratch_in,
)
from mortarbench.harness.results.journal import Journal, read_journal
from mortarbench.harness.results.work_unit import (
    Commands,
    Opens,
    Outcome,
    Result,
    Unbuilt,
    Unmade,
)
from mortarbench.harness.running.executor import one_by_one
from mortarbench.harness.running.progress import Progress
from mortarbench.harness.running.schedule import Schedule
from mortarbench.harness.suite.suite import Suite
from mortarbench.harness.verify.verdicts import plain

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Missing:
    """What a run could not measure; the same command tries it again."""

    unbuilt: list[str]  #: names of the cases that could not be built
    faults: list[
        Fault
    ]  #: of measurements that something else than the solver prevented


def run(
    suite: Suite,
    *,
    out: Path,
    commands: Commands,
    resolve: Callable[[SolverSpec], Solver],
    environment: Mapping[str, Any],
    digest: str,
    progress: Progress,
    fresh: bool = False,
    engine: Opens = one_by_one,
) -> Missing:
    """Measure what the result folder `out` lacks of `suite`; return what it still does.

    resolve : configures the solver, whose options go into the records
    environment, digest : what to write into environment.json, and its digest
    fresh : forget first what `out` holds
    engine : where the blocks are carried out

    Raises
    ------
    InputError
        When `out` is no result folder, holds another suite, case or environment, is in
        use, or was moved or deleted meanwhile, or its disk is full. Any other failure
        costs the measurements it concerns.

    """
    refuse_foreign(out)
    environment = {"digest": digest, **environment}
    with (
        ended_by_signals(),
        _continuation_told(progress),
        report_full_disk(out),
        locked(out) as held,
    ):
        options = {s.label: options_of(resolve(s)) for s in suite.solvers}
        past: list[Record] = []
        if not fresh:
            grown = refuse_other(out, suite, environment)
            there = next((out / "journal").glob("*.jsonl"), None) is not None
            past = read_journal(out) if there else []
            _check_same(out, past, suite, options)
            if grown:
                _check_steps(out, past, suite)
        sources = [s for c in suite.names if (s := c.family.source_file(c.params))]
        if fresh:
            refuse_own_copies(out, sources)
        claim(out, suite, environment, fresh=fresh)
        keep_copies(out, sources, progress.warn)
        with (
            scratch_in(out) as scratch,
            Journal(out, digest, progress.warn) as journal,
        ):
            schedule = Schedule(
                suite=suite,
                options=options,
                environment=digest,
                session=token_hex(6),
                progress=progress,
            )
            for record in past:
                schedule.note(record)
            progress.start(schedule.cells)
            book = _Book(
                out=out,
                held=held,
                journal=journal,
                schedule=schedule,
                progress=progress,
            )
            with engine(commands, scratch, out.resolve() / "cases") as execute:
                for outcome in execute(schedule.blocks()):
                    book.take(outcome)
                    if book.was_deleted:
                        describe(out, suite, environment)
                        journal.restore()
                        raise InputError(
                            f"{out} was deleted while the run wrote to it; its journal "
                            "is there again, solutions stored before are lost; the "
                            "same command continues"
                        )
        return Missing(unbuilt=schedule.unbuilt, faults=book.left())


@dataclass(eq=False, kw_only=True)
class _Book:
    """Writes down what an engine gives back, once, and tells who watches."""

    out: Path
    held: Held
    journal: Journal
    schedule: Schedule
    progress: Progress
    was_deleted: bool = False  #: the folder, since the last time
    _counted: set[str] = field(default_factory=set)  # run ids that were told
    _left: dict[str, Fault] = field(default_factory=dict)

    def take(self, outcome: Outcome) -> None:
        """Write down one result, or why there is none.

        Raises
        ------
        InputError
            When the folder was moved, or taken by another run, meanwhile.
        OSError
            When the disk is full, say; then nothing of the result is in the journal.

        """
        match outcome:
            case Unbuilt():
                _log.debug("%s\n%s", outcome.reason, outcome.trace)
                if self.schedule.give_up(outcome.block):
                    self.progress.warn(outcome.reason)
                for turn in outcome.block.turns:
                    for record in turn:
                        self._count(record, None)
            case Unmade():
                self._take_fault(outcome)
            case Result() if self.schedule.knows(outcome.record):
                # of a block, or a sequence, that was done again
                self._count(outcome.record, None)
            case Result():
                self._take_result(outcome)

    def left(self) -> list[Fault]:
        """List the last fault of each measurement that was not made."""
        return [f for run_id, f in self._left.items() if not self.schedule.made(run_id)]

    def _take_result(self, result: Result) -> None:
        record = result.record
        if result.part:
            number = self.schedule.number_of_part(record.block, result.part)
            record = record.replace(block=number)
        self.was_deleted = not self.held.is_there()
        if result.point is not None:
            record = record.replace(vectors=save(self.out, result.point))
        if result.fields is not None:
            record = record.replace(fields=save(self.out, result.fields))
        self.journal.append(record)
        self.schedule.note(record)
        self._count(record, record)

    def _take_fault(self, unmade: Unmade) -> None:
        record, what = unmade.record, unmade.reason
        fault = Fault(
            time=datetime.now(UTC).isoformat(timespec="milliseconds"),
            run_id=record.run_id,
            case=record.case,
            solver=record.solver,
            what=what,
            tried_again=unmade.tried_again,
        )
        self.was_deleted = not self.held.is_there()
        with Lines(self.out / FAULTS, self.progress.warn) as faults:
            faults.append(fault.to_json())
        then = "it is tried again" if unmade.tried_again else "it was not measured"
        self.progress.warn(f"{record.solver} on {record.case}: {what}; {then}")
        if not unmade.tried_again:
            self._left[record.run_id] = fault
            self._count(record, None)

    def _count(self, record: Record, measured: Record | None) -> None:
        """Tell of each cell once, whatever came of it and however often."""
        if record.run_id not in self._counted:
            self._counted.add(record.run_id)
            self.progress.advance(measured)


@contextmanager
def _continuation_told(progress: Progress) -> Iterator[None]:
    try:
        yield
    except TerminatedError:
        progress.warn("terminated; the same command continues")
        raise


def _check_same(
    out: Path,
    past: list[Record],
    suite: Suite,
    options: Mapping[str, Mapping[str, Any]],
) -> None:
    """Refuse to go on where a name now means another thing, or none.

    A label has other options, a case is in the suite no longer, or its file has
    changed.
    """
    now = {case.name: case.params for case in suite.names}
    asked = {label: finite(plain(given)) for label, given in options.items()}
    for record in past:
        if suite.every and record.case not in suite.every:
            raise InputError(
                f"{out} holds {record.case}, which the suite has no longer; cases may "
                f"be added, and --case narrows a run; {REMEDY}"
            )
        given = asked.get(record.solver, record.options)
        for key in given.keys() | record.options.keys():
            then, at_present = record.options.get(key), given.get(key)
            if then != at_present:
                raise InputError(
                    f"{out} holds {record.solver} with {key} = {shown(then)}, now "
                    f"{shown(at_present)}; give other options another label"
                )
        params = now.get(record.case, record.params)
        for key in params.keys() & record.params.keys():
            if record.params[key] != params[key]:
                raise InputError(
                    f"{out} holds {record.case} with {key} = {record.params[key]}, "
                    f"now {params[key]}; {REMEDY}"
                )


def _check_steps(out: Path, past: list[Record], suite: Suite) -> None:
    """Refuse a sequence that has new steps before some that were driven."""
    driven: dict[tuple[str, str, float, int], list[str]] = {}
    for r in past:
        if r.mode != "cold":
            driven.setdefault((r.mode, r.solver, r.tol, r.repeat), []).append(r.case)
    for sequence in suite.sequences:
        steps = [case.name for case in sequence]
        for cases in driven.values():
            known = [case for case in cases if case in steps]
            if known != steps[: len(known)]:
                raise InputError(
                    f"{out} holds a sequence that came to {known[-1]} by other steps; "
                    f"steps may be added at its end; {REMEDY}"
                )
