"""Schedule of a suite: remaining measurements and their order.

The experimental design is a randomised complete block design. In each block, every
solver is measured once on one case (or sequence) at one tolerance, in random order.
Every second repeat reverses the order of the previous repeat.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any

from mortarbench.harness.record import Record, Verdict
from mortarbench.harness.results.work_unit import WorkUnit
from mortarbench.harness.running.progress import Progress
from mortarbench.harness.suite.parameter_grid import Group
from mortarbench.harness.suite.suite import Suite
from mortarbench.harness.verify.verdicts import new_record

Cell = tuple[str, str, float]  #: mode, name of the case, and tolerance
LIMITS = (Verdict.TIME_LIMIT, Verdict.MEMORY_LIMIT)


@dataclass(eq=False, kw_only=True)
class Schedule:
    """Remaining blocks of measurements of a suite, in the order of execution."""

    suite: Suite
    #: options by solver label, including those with default values
    options: Mapping[str, Mapping[str, Any]]
    environment: str  #: digest of the environment
    session: str = ""  #: session of the run, see `harness.record.Record`
    progress: Progress
    #: names of the cases that could not be built
    unbuilt: list[str] = field(default_factory=list)
    #: solver and cell of each case that it declined, or that is beyond a limit
    _omitted: set[tuple[str, Cell]] = field(default_factory=set)
    #: number of variables by name of the case, for measured cases
    _variables: dict[str, int] = field(default_factory=dict)
    #: run IDs of the measurements in the journal
    _done: set[str] = field(default_factory=set)
    _next: int = 0  # number of the next new block

    @property
    def cells(self) -> int:
        """Largest possible number of measurements of the suite."""
        s, cases = self.suite.file, len(self.suite.cases.all)
        return cases * len(s.tolerances) * s.repeats * len(self.suite.solvers)

    def add(self, record: Record) -> None:
        """Take a measurement in the journal into account.

        A solver that hit a limit on a case is not measured on cases in which integer
        keys are larger, if the number of variables grew with these keys up to the case.
        """
        self._done.add(record.run_id)
        self._next = max(self._next, record.block + 1)
        if "variables" in record.sizes:
            self._variables[record.case] = record.sizes["variables"]
        if record.status is Verdict.DECLINED:
            self._omitted.add((record.solver, _cell(record)))
        if record.status in LIMITS and record.mode == "cold":
            size, params = self._variables.get(record.case, 0), record.params
            alike = [
                c
                for c in self.suite.cases.cold
                if (c.family_name, c.form) == (record.family, record.form)
            ]
            growing = {
                larger_keys(c.params, params)
                for c in alike
                if self._variables.get(c.name, size) < size
            }
            for c in alike:
                if larger_keys(params, c.params) in growing - {frozenset()}:
                    cell = (record.mode, c.name, record.tol)
                    self._omitted.add((record.solver, cell))

    def is_settled(self, record: Record) -> bool:
        """Return True if a measurement is in the journal, or is not needed.

        A solver that declined a case would decline it in every repeat.
        """
        cell = record.solver, _cell(record)
        return record.run_id in self._done or cell in self._omitted

    def is_measured(self, run_id: str) -> bool:
        """Return True if the measurement is in the journal."""
        return run_id in self._done

    def give_up(self, block: WorkUnit) -> bool:
        """Mark the cases of a block as unbuilt; return False if all already were."""
        new = [case for case in block.cases if case not in self.unbuilt]
        self.unbuilt += new
        return bool(new)

    def blocks(self) -> Iterator[WorkUnit]:
        """Yield the remaining blocks.

        Each block is determined when it is requested, so that it takes all measurements
        before it into account.
        """
        s = self.suite.file
        for together in self.suite.cases.groups:
            for tol, repeat, group in product(s.tolerances, range(s.repeats), together):
                block = self._block(group, tol, repeat)
                if block is not None:
                    first = block.turns[0][0]
                    self.progress.say(f"{first.case}, tol {tol:g}, repeat {repeat + 1}")
                    yield block

    def _block(self, group: Group, tol: float, repeat: int) -> WorkUnit | None:
        """Return a block with its remaining turns in random order; None if none remain.

        If any step of a sequence is missing, all steps are measured again, because a
        solver carries data from step to step.
        """
        turns = []
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
                    accuracy=self.suite.file.accuracy,
                )
                for case in group.cases
            )
            if is_given_up or all(map(self.is_settled, turn)):
                for _ in turn:
                    self.progress.advance(None)
            else:
                turns.append(turn)
        if not turns:
            return None
        # Repeats 2k and 2k + 1 have the same seed, and the second of them reverses the
        # order of the first. All solvers thus have the same mean position in the two
        # repeats.
        seed = f"{self.suite.file.name} {group.cases[0]} {tol} {repeat // 2}"
        random.Random(seed).shuffle(turns)
        if repeat % 2:
            turns.reverse()
        self._next += 1
        return WorkUnit(
            turns=tuple(turns),
            time_limit=self.suite.file.time_limit,
            memory_limit=self.suite.file.memory_limit,
        )


def _cell(record: Record) -> Cell:
    return record.mode, record.case, record.tol


def larger_keys(
    smaller: Mapping[str, Any], larger: Mapping[str, Any]
) -> frozenset[str]:
    """Return the keys that differ, if all are integers that are larger in `larger`.

    Otherwise, the set is empty.
    """
    pairs = {k: (v, larger.get(k)) for k, v in smaller.items() if v != larger.get(k)}
    if all(type(a) is type(b) is int and a < b for a, b in pairs.values()):
        return frozenset(pairs)
    return frozenset()
