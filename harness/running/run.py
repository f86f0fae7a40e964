"""Run of a suite: scheduling, resumption, and one journal line per measurement.

This process selects the measurements, and it alone writes their results to the result
folder. An executor on this machine, or executors on a cluster, measure the blocks.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from secrets import token_hex
from typing import Any

from mortarbench.harness.errors import InputError
from mortarbench.harness.files.durable import report_full_disk
from mortarbench.harness.files.store import save
from mortarbench.harness.plugin import Solver
from mortarbench.harness.processes.termination import ended_by_signals
from mortarbench.harness.record import Record, finite
from mortarbench.harness.registry import SolverSpec, options_of
from mortarbench.harness.results.folder import (
    REMEDY,
    claim,
    lock_folder,
    refuse_foreign,
    refuse_other,
    scratch_in,
)
from mortarbench.harness.results.journal import (
    Journal,
    check_labels,
    read_journal,
)
from mortarbench.harness.results.work_unit import (
    BuildFailure,
    Commands,
    Execute,
    MeasurementFault,
    Outcome,
    Result,
)
from mortarbench.harness.running.executor import execute as execute_here
from mortarbench.harness.running.progress import Progress
from mortarbench.harness.running.schedule import Schedule
from mortarbench.harness.suite.suite import Suite
from mortarbench.harness.verify.verdicts import plain


@dataclass(frozen=True, kw_only=True)
class Missing:
    """Measurements that are missing after a run; the same command repeats them."""

    unbuilt: list[str]  #: names of the cases that could not be built
    #: measurements prevented by faults of the harness or the machine, with the reasons
    faults: list[str]


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
    execute: Execute = execute_here,
) -> Missing:
    """Complete the measurements of `suite` in the result folder `out`.

    resolve : returns a solver with its options set; all options are stored in records
    environment, digest : content of environment.json, and the digest of that content
    fresh : delete the previous results in `out` first
    execute : executes the blocks, on this machine or on a cluster

    Returns
    -------
    the measurements that are still missing

    Raises
    ------
    InputError
        If `out` is not a result folder, contains results of a different suite, case or
        environment, is in use, or was moved or deleted during the run, or if its disk
        is full. Any other failure affects only single cases or measurements, which are
        then missing.

    """
    refuse_foreign(out)
    environment = {"digest": digest, **environment}
    options = {s.label: options_of(resolve(s)) for s in suite.solvers}
    with (
        ended_by_signals(),
        report_full_disk(out),
        lock_folder(out),
    ):
        past: list[Record] = []
        if not fresh:
            refuse_other(out, suite, environment)
            has_journal = next((out / "journal").glob("*.jsonl"), None) is not None
            past = read_journal(out) if has_journal else []
            _check_same(out, past, suite, options)
        claim(out, suite, environment, fresh=fresh)
        with (
            scratch_in(out) as scratch,
            Journal(out, digest) as journal,
        ):
            schedule = Schedule(
                suite=suite,
                options=options,
                environment=digest,
                session=token_hex(6),
                progress=progress,
            )
            for record in past:
                schedule.add(record)
            progress.start(schedule.cells)
            recorder = _Recorder(
                out=out,
                journal=journal,
                schedule=schedule,
                progress=progress,
            )
            outcomes = execute(schedule.blocks(), commands, scratch)
            with contextlib.closing(outcomes):
                for outcome in outcomes:
                    recorder.take(outcome)
        return Missing(unbuilt=schedule.unbuilt, faults=recorder.faults)


@dataclass(eq=False, kw_only=True)
class _Recorder:
    """Writer that stores each outcome once and reports progress."""

    out: Path
    journal: Journal
    schedule: Schedule
    progress: Progress
    faults: list[str] = field(default_factory=list)  #: reasons of missing measurements

    def take(self, outcome: Outcome) -> None:
        """Store one result, or the reason why it is missing.

        Raises
        ------
        InputError
            If another program has moved, deleted or changed the journal.
        OSError
            If the result cannot be written, for instance because the disk is full; the
            journal then has no line for this result.

        """
        # if the folder was moved, solutions would be stored in a new folder
        self.journal.check()
        match outcome:
            case BuildFailure():
                if self.schedule.give_up(outcome.block):
                    self.progress.warn(outcome.reason)
                for _ in chain.from_iterable(outcome.block.turns):
                    self.progress.advance(None)
            case MeasurementFault():
                record = outcome.record
                fault = f"{record.solver} on {record.case}: {outcome.reason}"
                self.progress.warn(f"{fault}; it was not measured")
                self.faults.append(fault)
                self.progress.advance(None)
            case Result() if self.schedule.is_measured(outcome.record.run_id):
                # a repetition of a block or sequence: only the first result counts
                self.progress.advance(None)
            case Result():
                self._take_result(outcome)

    def _take_result(self, result: Result) -> None:
        record = result.record
        # Write the line last, because it must not refer to missing files.
        if result.point is not None:
            record = record.replace(vectors=save(self.out, result.point))
        if result.fields is not None:
            record = record.replace(fields=save(self.out, result.fields))
        self.journal.append(record)
        self.schedule.add(record)
        self.progress.advance(record)


def _check_same(
    out: Path,
    past: list[Record],
    suite: Suite,
    options: Mapping[str, Mapping[str, Any]],
) -> None:
    """Check that no name changed its meaning since the last run.

    Raises
    ------
    InputError
        If a solver label now has another solver or other options, or a parameter of a
        case, such as the digest of its file, has changed.

    """
    labels = {
        spec.label: (spec.name, finite(plain(options[spec.label])))
        for spec in suite.solvers
    }
    check_labels(str(out), past, labels)
    cases = {case.name: case.params for case in suite.cases.all}
    for r in past:
        params = cases.get(r.case, r.params)
        for key in params.keys() & r.params.keys():
            if r.params[key] != params[key]:
                raise InputError(
                    f"{out} contains {r.case} with {key} = {r.params[key]}, "
                    f"now {params[key]}; {REMEDY}"
                )
