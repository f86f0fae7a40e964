"""Blocks, the work units of a run, as plain data that any process can execute.

In a block, every solver is measured once on one case at one tolerance, in random order.
A drift of the machine then affects all solvers of a block similarly. For this reason,
solvers are compared within blocks. In a block of a sequence, every solver solves all
steps once, in the order of the sequence.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from mortarbench.harness.files.store import Arrays
from mortarbench.harness.record import Record


@dataclass(frozen=True, kw_only=True)
class Commands:
    """Command lines of the processes of a run, without the arguments for pipes."""

    #: commands that run `harness.processes.worker`, by label of the solver
    solvers: Mapping[str, list[str]]
    case_worker: list[str]  #: command that runs `harness.processes.case_worker`
    #: True if solver processes run no plug-in code; verdicts on distributed
    #: QPs may then be computed in these processes
    own_code_only: bool = False


@dataclass(frozen=True, kw_only=True)
class WorkUnit:
    """A block: the remaining measurements of all solvers on one case or sequence."""

    number: int
    #: incomplete records of each solver, in the order of measurement: one record for a
    #: case, or one record for each step of a sequence
    turns: tuple[tuple[Record, ...], ...]
    time_limit: float  #: time limit of a measurement, s
    memory_limit: float  #: memory limit of a measurement, MiB

    @property
    def cases(self) -> tuple[str, ...]:
        """Names of the cases of the block, in order."""
        return tuple(record.case for record in self.turns[0])

    @property
    def is_sequence(self) -> bool:
        """True for a sequence, in which solvers may reuse results of earlier steps."""
        return self.turns[0][0].mode != "cold"


@dataclass(frozen=True, eq=False, kw_only=True)
class Result:
    """Outcome of a measurement that was completed."""

    record: Record  #: record, complete except for the digests of `point` and `fields`
    #: number of the part of the block; a block has several parts if its measurements
    #: were interrupted, and only measurements in the same part ran consecutively
    part: int = 0
    #: arrays of the point; None if the solver returned no point
    point: Arrays | None = None
    fields: Arrays | None = None  #: deformed state; None if it is not to be stored


@dataclass(frozen=True, kw_only=True)
class BuildFailure:
    """Outcome of a block whose case, or one of whose cases, could not be built."""

    block: WorkUnit
    reason: str  #: reason in one line
    trace: str = ""  #: traceback of the exception if the family's code raised it


@dataclass(frozen=True, kw_only=True)
class MeasurementFault:
    """Outcome of a measurement that the harness or the machine prevented."""

    record: Record  #: incomplete record of the missing measurement
    reason: str  #: reason in one line
    #: True if the measurement is repeated, which yields a further outcome
    tried_again: bool


Outcome = Result | BuildFailure | MeasurementFault


class Engine(Protocol):
    """Function that executes blocks, on this machine or on the nodes of a cluster.

    An engine may take several blocks from the iterator before it yields outcomes. An
    engine may yield outcomes of several blocks in any order, and may yield the outcomes
    of a lost block again. A block is created when the engine takes it, and the decision
    on further repeats depends only on outcomes that were yielded before. An engine
    should therefore take as few blocks as possible in advance.
    """

    def __call__(self, blocks: Iterator[WorkUnit]) -> Iterable[Outcome]:
        """Execute all `blocks`, and yield the outcomes of their measurements."""


class EngineFactory(Protocol):
    """Function that opens the engine of a run."""

    def __call__(
        self, commands: Commands, scratch: Path, cases: Path
    ) -> AbstractContextManager[Engine]:
        """Return a context manager that opens an engine, and closes it at the end.

        commands : command lines of the processes that the engine starts
        scratch : temporary folder that exists for the duration of the run
        cases : folder of built cases, see `harness.processes.case_folder`
        """
