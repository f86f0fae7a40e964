"""A suite, measured: the schedule, resumption, and one journal line per measurement.

This process decides what is measured, and alone writes the result folder; an engine
carries out the blocks. So a run is the same on one machine and on many.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from harness.block import Commands, Opens, Result, Unbuilt
from harness.errors import InputError
from harness.folder import claim, locked, refuse_foreign, scratch_in
from harness.journal import Journal, read_journal
from harness.names import canonical
from harness.plugin import Family, Solver
from harness.progress import Progress
from harness.record import Record
from harness.registry import SolverSpec, options_of
from harness.schedule import Schedule
from harness.station import one_by_one
from harness.store import save
from harness.suite import Suite

_log = logging.getLogger(__name__)


def run(
    suite: Suite,
    *,
    families: Mapping[str, Family],
    out: Path,
    commands: Commands,
    resolve: Callable[[SolverSpec], Solver],
    environment: Mapping[str, Any],
    digest: str,
    progress: Progress,
    fresh: bool = False,
    engine: Opens = one_by_one,
) -> list[str]:
    """Measure what the result folder `out` lacks of `suite`.

    Returns the names of the cases that could not be built: they have no records, so
    that the same command tries them again.

    resolve : configures the solver, whose options go into the records
    environment, digest : what to write into environment.json, and its digest
    fresh : forget first what `out` holds
    engine : where the blocks are carried out

    Raises
    ------
    InputError
        When `out` is no result folder, holds another suite, case or environment, or is
        in use. Any other failure costs the measurements it concerns.

    """
    refuse_foreign(out)
    with locked(out):
        claim(out, suite, {"digest": digest, **environment}, fresh=fresh)
        with scratch_in(out) as scratch, Journal(out, digest) as journal:
            past = read_journal(out)
            _check_same(out, past, suite, families)
            schedule = Schedule(
                suite=suite,
                families=families,
                options={s.label: options_of(resolve(s)) for s in suite.solvers},
                environment=digest,
                progress=progress,
            )
            for record in past:
                schedule.note(record)
            progress.start(schedule.cells)
            with engine(commands, scratch, out.resolve() / "cases") as carry_out:
                for result in carry_out(schedule.blocks()):
                    _take(result, schedule, journal, out, progress)
        return [canonical(c, families[c.family]) for c in schedule.unbuilt]


def _take(
    result: Result | Unbuilt,
    schedule: Schedule,
    journal: Journal,
    out: Path,
    progress: Progress,
) -> None:
    """Write down what an engine gives back, once, and tell who watches."""
    if isinstance(result, Unbuilt):
        _log.debug("%s\n%s", result.reason, result.trace)
        if schedule.give_up(result.block):
            progress.warn(result.reason)
        for _ in range(sum(map(len, result.block.turns))):
            progress.advance(None)
        return
    record = result.record
    if schedule.knows(record):  # of a block, or a sequence, that was done again
        progress.advance(None)
        return
    if result.point is not None:
        record = record.but(vectors=save(out, result.point))
    if result.fields is not None:
        record = record.but(fields=save(out, result.fields))
    journal.append(record)
    schedule.note(record)
    progress.advance(record)


def _check_same(
    out: Path, past: list[Record], suite: Suite, families: Mapping[str, Family]
) -> None:
    """Refuse to go on where a name now means another case: its file has changed."""
    now = {canonical(c, families[c.family]): c.params for c in suite.names}
    for record in past:
        params = now.get(record.case, record.params)
        for key in params.keys() & record.params.keys():
            if record.params[key] != params[key]:
                raise InputError(
                    f"{out} holds {record.case} with {key} = {record.params[key]}, "
                    f"now {params[key]}; choose another --out or use --fresh"
                )
