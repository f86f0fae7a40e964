"""A suite, measured: the schedule, resumption, and one journal line per measurement.

This process decides what is measured, and alone writes the result folder; an engine
carries out the blocks. So a run is the same on one machine and on many.
"""

from __future__ import annotations

import logging
import random
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from harness.block import Block, Commands, Opens, Result, Unbuilt
from harness.errors import InputError
from harness.folder import claim, locked, refuse_foreign, scratch_in
from harness.journal import Journal, read_journal
from harness.judge import blank
from harness.names import CaseName, canonical
from harness.plugin import Family, Solver
from harness.record import Record, Verdict
from harness.registry import SolverSpec, options_of
from harness.station import one_by_one
from harness.store import save
from harness.suite import Suite

_log = logging.getLogger(__name__)


class Progress(Protocol):
    """Who is told how a run goes."""

    def start(self, total: int) -> None:
        """Begin; `total` cells, those that an earlier run measured included."""

    def say(self, text: str) -> None:
        """Show what happens now."""

    def warn(self, text: str) -> None:
        """Show what went wrong, in a line that stays."""

    def advance(self, record: Record | None) -> None:
        """Count one cell as done; None where nothing had to be measured."""


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
            schedule = _Schedule(
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
    schedule: _Schedule,
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
    if schedule.knows(record):  # a lost block was carried out twice
        return
    if result.point is not None:
        record = record.but(vectors=save(out, result.point))
    if result.fields is not None:
        record = record.but(fields=save(out, result.fields))
    journal.append(record)
    schedule.note(record)
    progress.advance(record)


@dataclass(eq=False, kw_only=True)
class _Schedule:
    """Which measurements are left, block by block."""

    suite: Suite
    families: Mapping[str, Family]
    options: Mapping[str, Mapping[str, Any]]  #: of each solver, defaults resolved
    environment: str  #: digest
    progress: Progress
    unbuilt: list[CaseName] = field(default_factory=list)
    _done: set[str] = field(default_factory=set)  #: run ids
    _declined: set[tuple[str, str, float]] = field(default_factory=set)
    _next: int = 0  #: number of a new block

    @property
    def cells(self) -> int:
        """Count the measurements of the suite."""
        s = self.suite
        return len(s.cases) * len(s.tolerances) * s.repeats * len(s.solvers)

    def note(self, record: Record) -> None:
        """Know of a measurement that is in the journal."""
        self._done.add(record.run_id)
        self._next = max(self._next, record.block + 1)
        if record.status is Verdict.DECLINED:
            self._declined.add((record.solver, record.case, record.tol))

    def knows(self, record: Record) -> bool:
        """Whether nothing is left to be learnt from measuring that."""
        key = (record.solver, record.case, record.tol)
        return record.run_id in self._done or key in self._declined

    def give_up(self, block: Block) -> bool:
        """Leave out the cases of a block that cannot be built; False if known."""
        new = [case for case in block.cases if case not in self.unbuilt]
        self.unbuilt += new
        return bool(new)

    def blocks(self) -> Iterator[Block]:
        """Make the blocks, each when it is asked for."""
        suite = self.suite
        for case in suite.cases:
            for tol in suite.tolerances:
                for repeat in range(suite.repeats):
                    block = self._block(case, tol, repeat)
                    if block is not None:
                        first = block.turns[0][0]
                        self.progress.say(f"{first.case}, tol {tol:g}, {repeat + 1}")
                        yield block

    def _block(self, name: CaseName, tol: float, repeat: int) -> Block | None:
        """Shuffle what is left of a block."""
        case = canonical(name, self.families[name.family])
        left = []
        for spec in self.suite.solvers:
            record = blank(
                name,
                case,
                spec,
                options=self.options[spec.label],
                tol=tol,
                repeat=repeat,
                block=self._next,
                environment=self.environment,
            )
            if name in self.unbuilt or self.knows(record):
                self.progress.advance(None)
            else:
                left.append((record,))
        if not left:
            return None
        random.Random(f"{self.suite.name} {case} {tol} {repeat}").shuffle(left)
        self._next += 1
        return Block(
            number=left[0][0].block,
            cases=(name,),
            turns=tuple(left),
            time_limit=self.suite.time_limit,
            memory_limit=self.suite.memory_limit,
        )


def _check_same(
    out: Path, past: list[Record], suite: Suite, families: Mapping[str, Family]
) -> None:
    """Refuse to go on where a name now means another case: its file has changed."""
    now = {canonical(c, families[c.family]): c.params for c in suite.cases}
    for record in past:
        params = now.get(record.case, record.params)
        for key in params.keys() & record.params.keys():
            if record.params[key] != params[key]:
                raise InputError(
                    f"{out} holds {record.case} with {key} = {record.params[key]}, "
                    f"now {params[key]}; choose another --out or use --fresh"
                )
