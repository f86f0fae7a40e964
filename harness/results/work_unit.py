"""Unit of work of a run, as plain data that can be sent to any process or machine.

In a block, every solver is measured once on one case at one tolerance, in random order.
A drift of the machine then affects all solvers of a block alike, and they are compared
within blocks. In a block of a sequence, every solver solves all steps once, in order.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from mortarbench.harness.files.store import Arrays
from mortarbench.harness.record import Record


@dataclass(frozen=True, kw_only=True)
class Commands:
    """Command lines of the processes of a run, without the two pipes of each."""

    #: commands by label; they run `harness.processes.worker`
    solvers: Mapping[str, list[str]]
    case_worker: list[str]  #: runs `harness.processes.case_worker`
    #: True if all code in the solvers' processes is ours; ranks then judge answers
    own_code_only: bool = False


@dataclass(frozen=True, kw_only=True)
class WorkUnit:
    """A block: the measurements to be made, in order."""

    number: int
    #: one turn per solver, in the order of measurement: its records, to be completed,
    #: one for the case or one for each step of the sequence
    turns: tuple[tuple[Record, ...], ...]
    time_limit: float  #: time limit of a measurement, s
    memory_limit: float  #: memory limit of a measurement, MiB
    #: Fields of a small case that a new process builds first, so that the time of its
    #: next build excludes first calls. None: cases of earlier blocks may be reused
    warm_up: Mapping[str, Any] | None = None

    @property
    def cases(self) -> tuple[str, ...]:
        """Names of its cases, in order."""
        return tuple(record.case for record in self.turns[0])

    @property
    def is_sequence(self) -> bool:
        """True if solvers may use, in a step, data of the earlier steps."""
        return self.turns[0][0].mode != "cold"


@dataclass(frozen=True, eq=False, kw_only=True)
class Result:
    """One measurement of a block."""

    record: Record  #: complete except for the digests of `point` and `fields`
    part: int = 0  #: part of its block; parts were not measured next to each other
    point: Arrays | None = None  #: None if the solver returned none
    fields: Arrays | None = None  #: deformed state, if it is to be stored


@dataclass(frozen=True, kw_only=True)
class BuildFailure:
    """Outcome of a block with a case that could not be built."""

    block: WorkUnit
    reason: str  #: one line
    trace: str = ""  #: traceback of the family's code


@dataclass(frozen=True, kw_only=True)
class MeasurementFault:
    """Outcome of a measurement that the harness or the machine prevented."""

    record: Record  #: record of the missing measurement
    reason: str  #: one line
    tried_again: bool  #: True if another `MeasurementFault`, or a `Result`, follows


Outcome = Result | BuildFailure | MeasurementFault


class Engine(Protocol):
    """Executor of blocks, on this machine one by one, or elsewhere.

    An engine may take several blocks before it yields results, yield the outcomes of
    several blocks in any order, and yield those of a lost block again. Blocks are
    created when they are taken, and the stopping rule sees only earlier results. So an
    engine should take as few as possible in advance.
    """

    def __call__(self, blocks: Iterator[WorkUnit]) -> Iterable[Outcome]:
        """Execute all of `blocks`."""


class EngineFactory(Protocol):
    """Factory of the engine of a run."""

    def __call__(
        self, commands: Commands, scratch: Path, cases: Path
    ) -> AbstractContextManager[Engine]:
        """Open an engine.

        scratch : temporary folder that exists for the duration of the run
        cases : folder of built cases, see `harness.processes.case_folder`
        """
