"""Which measurements of a suite are left, in which order, and when there are enough.

Blocks are complete and randomised: each is every solver once on one case (or one
sequence) at one tolerance, in random order, and every second one in the reverse order
of the one before. With a precision to reach, blocks go on beyond the repeats
of the suite until the ratio of every verified solver to the fastest is known so well,
by the paired interval of `harness.running.pairs`, or a limit is met. The rule is in the
suite, before anything is measured, and uses the journal alone: a resumed run stops
where an undisturbed one does.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from mortarbench.harness.record import Record, Verdict
from mortarbench.harness.results.work_unit import WorkUnit
from mortarbench.harness.running.pairs import Block, largest_half_width
from mortarbench.harness.running.progress import Progress
from mortarbench.harness.suite.suite import Group, Suite
from mortarbench.harness.verify.verdicts import new_record

Cell = tuple[str, str, float]  #: mode, case and tolerance


@dataclass(eq=False, kw_only=True)
class Schedule:
    """The blocks of a suite, given what the journal holds."""

    suite: Suite
    options: Mapping[str, Mapping[str, Any]]  #: of each solver, defaults resolved
    environment: str  #: digest
    session: str = ""  #: of the run, see `harness.record.Record`
    progress: Progress
    unbuilt: list[str] = field(default_factory=list)  #: names of cases
    _seen: dict[Cell, list[Record]] = field(default_factory=dict)  # for `_enough`
    _declined: set[tuple[str, Cell]] = field(default_factory=set)
    _done: set[str] = field(default_factory=set)  #: run ids
    _next: int = 0  #: number of a new block
    _parts: dict[tuple[int, int], int] = field(default_factory=dict)  # their numbers

    @property
    def cells(self) -> int:
        """Count the measurements that the suite has at most."""
        s = self.suite
        return len(s.names) * len(s.tolerances) * self._most * len(s.solvers)

    def add(self, record: Record) -> None:
        """Know of a measurement that is in the journal."""
        self._done.add(record.run_id)
        self._next = max(self._next, record.block + 1)
        if record.verdict is Verdict.DECLINED:
            self._declined.add((record.solver, _cell(record)))
        if self.suite.precision is not None:
            self._seen.setdefault(_cell(record), []).append(record)

    def is_settled(self, record: Record) -> bool:
        """Whether nothing is left to be learnt from measuring that."""
        declined = (record.solver, _cell(record)) in self._declined
        return declined or record.run_id in self._done

    def is_measured(self, run_id: str) -> bool:
        """Whether that measurement is in the journal."""
        return run_id in self._done

    def block_of_part(self, block: int, part: int) -> int:
        """Give what was measured later or elsewhere of a block a number of its own."""
        if (block, part) not in self._parts:
            self._parts[block, part] = self._next
            self._next += 1
        return self._parts[block, part]

    def give_up(self, block: WorkUnit) -> bool:
        """Leave out the cases of a block that cannot be built; False if known."""
        new = [case for case in block.cases if case not in self.unbuilt]
        self.unbuilt += new
        return bool(new)

    def blocks(self) -> Iterator[WorkUnit]:
        """Make the blocks, each when it is asked for."""
        for group in self.suite.groups:
            for tol in self.suite.tolerances:
                for repeat in range(self._most):
                    if repeat >= self.suite.repeats and self._enough(group, tol):
                        self._skip(len(group.cases) * len(self.suite.solvers))
                        continue
                    block = self._block(group, tol, repeat)
                    if block is not None:
                        first = block.turns[0][0]
                        self.progress.say(
                            f"{first.case}, tol {tol:g}, repeat {repeat + 1}"
                        )
                        yield block

    @property
    def _most(self) -> int:
        s = self.suite
        return s.repeats if s.precision is None else max(s.repeats, s.max_repeats)

    def _enough(self, group: Group, tol: float) -> bool:
        """Whether every ratio is known well enough, or there is no budget left."""
        assert self.suite.precision is not None
        records = [
            r
            for case in group.cases
            for r in self._seen.get((group.mode, case.name, tol), ())
        ]
        if sum(r.total_seconds or 0.0 for r in records) >= self.suite.budget:
            return True
        failed = {r.solver for r in records if not r.verdict.is_verified}
        times: dict[str, dict[Block, float]] = {}
        for solver in {r.solver for r in records} - failed:
            mine = [r for r in records if r.solver == solver and r.total_seconds]
            times[solver] = _by_block(mine)
        width = largest_half_width(times)
        return width is None or width <= self.suite.precision

    def _block(self, group: Group, tol: float, repeat: int) -> WorkUnit | None:
        """Shuffle what is left of a block; of a sequence, a solver's whole turn is."""
        left = []
        is_given_up = any(case.name in self.unbuilt for case in group.cases)
        for spec in self.suite.solvers:
            turn = tuple(
                new_record(
                    case,
                    spec,
                    options=self.options[spec.label],
                    tol=tol,
                    repeat=repeat,
                    block=self._next,
                    environment=self.environment,
                    session=self.session,
                    mode=group.mode,
                    accuracy=self.suite.accuracy,
                )
                for case in group.cases
            )
            if is_given_up or all(map(self.is_settled, turn)):
                self._skip(len(turn))
            else:
                left.append(turn)
        if not left:
            return None
        seed = f"{self.suite.name} {group.cases[0]} {tol} {repeat // 2}"
        random.Random(seed).shuffle(left)
        if repeat % 2:  # who was first is last: no place in a block favours anybody
            left.reverse()
        self._next += 1
        return WorkUnit(
            number=left[0][0].block,
            turns=tuple(left),
            time_limit=self.suite.time_limit,
            memory_limit=self.suite.memory_limit,
        )

    def _skip(self, cells: int) -> None:
        for _ in range(cells):
            self.progress.advance(None)


def _by_block(records: Iterable[Record]) -> dict[Block, float]:
    """Add the seconds of the steps of each repeat.

    A sequence that was cut off and driven again is of several sessions, and is paired
    with nothing but such.
    """
    repeats: dict[int, list[Record]] = {}
    for r in records:
        repeats.setdefault(r.repeat, []).append(r)
    return {
        (" ".join(sorted({r.session for r in steps})), repeat): sum(
            r.total_seconds or 0.0 for r in steps
        )
        for repeat, steps in repeats.items()
    }


def _cell(record: Record) -> Cell:
    return record.mode, record.case, record.tol
