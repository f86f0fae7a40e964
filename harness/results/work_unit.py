"""Blocks, the work units of a run, as plain data that any process can execute.

In a block, every solver is measured once on one case at one tolerance, in random order.
A drift of the machine then affects all solvers of a block similarly. For this reason,
solvers are compared within blocks. In a block of a sequence, every solver solves all
steps once, in the order of the sequence.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from mortarbench.harness.files.store import Arrays
from mortarbench.harness.record import Record


@dataclass(frozen=True, kw_only=True)
class Commands:
    """Command lines of the processes of a run, without the arguments for pipes."""

    #: commands that run `harness.processes.worker`, by label of the solver
    solvers: Mapping[str, list[str]]
    case_worker: list[str]  #: command that builds and evaluates cases
    #: True if no plug-in is loaded; otherwise, processes that ran its code do not judge
    own_code_only: bool = False


@dataclass(frozen=True, kw_only=True)
class WorkUnit:
    """A block: the remaining measurements of all solvers on one case or sequence."""

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
    #: arrays of the point; None if the solver returned no point
    point: Arrays | None = None
    fields: Arrays | None = None  #: deformed state; None if it is not to be stored


@dataclass(frozen=True, kw_only=True)
class BuildFailure:
    """Outcome of a block whose case, or one of whose cases, could not be built."""

    block: WorkUnit
    reason: str  #: reason in one line


@dataclass(frozen=True, kw_only=True)
class MeasurementFault:
    """Outcome of a measurement that the harness or the machine prevented."""

    record: Record  #: incomplete record of the missing measurement
    reason: str  #: reason in one line


Outcome = Result | BuildFailure | MeasurementFault

#: Function that executes blocks with commands, in a scratch folder. It takes as few
#: blocks as possible in advance, since blocks depend on the outcomes of earlier ones.
Execute = Callable[[Iterator[WorkUnit], Commands, Path], Generator[Outcome]]
