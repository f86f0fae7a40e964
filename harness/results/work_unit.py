"""The unit of work of a run, as plain data that any process on any machine can take.

One block is every solver once on one case at one tolerance, in random order, so that a
drift of the machine hits all alike and solvers are compared within a block. Of a
sequence it is every solver once on all steps, one step after the other.
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
    """How the processes of a run are started, less the two pipes of each."""

    solvers: Mapping[str, list[str]]  #: by label; they serve `harness.processes.worker`
    case_worker: list[str]  #: serves `harness.processes.case_worker`
    #: whether no code but ours runs in the first: then ranks evaluate what they solve
    own_code_only: bool = False


@dataclass(frozen=True, kw_only=True)
class WorkUnit:
    """What to measure, in which order."""

    number: int
    #: per solver, in the order to measure: its records to fill in, one per case, which
    #: is one, or the steps of a sequence
    turns: tuple[tuple[Record, ...], ...]
    time_limit: float  #: s per measurement
    memory_limit: float  #: MiB per measurement

    @property
    def cases(self) -> tuple[str, ...]:
        """The names of its cases, in order."""
        return tuple(record.case for record in self.turns[0])

    @property
    def is_sequence(self) -> bool:
        """Whether each solver may use, at a step, what the earlier ones left."""
        return self.turns[0][0].mode != "cold"


@dataclass(frozen=True, eq=False, kw_only=True)
class Result:
    """One measurement of a block."""

    record: Record  #: complete but for the digests of what is to be stored
    part: int = 0  #: of its block; parts of one block were not measured together
    point: Arrays | None = None  #: where the solver returned one
    fields: Arrays | None = None  #: the deformed state, where it is to be stored


@dataclass(frozen=True, kw_only=True)
class BuildFailure:
    """Instead of results: a case of the block could not be built."""

    block: WorkUnit
    reason: str  #: one line
    trace: str = ""  #: of the family's code


@dataclass(frozen=True, kw_only=True)
class MeasurementFault:
    """Instead of a result: a fault of ours or of the machine prevented it."""

    record: Record  #: of what was to be measured
    reason: str  #: one line
    tried_again: bool  #: at once: another `MeasurementFault`, or a `Result`, follows


Outcome = Result | BuildFailure | MeasurementFault


class Engine(Protocol):
    """Where blocks are carried out: on this machine one by one, or elsewhere.

    It may take blocks ahead of giving back their results, and give results of several
    blocks in any order; those of a block that is lost it may give again. Blocks are
    made as they are taken: the less is taken ahead, the sooner a run can stop.
    """

    def __call__(self, blocks: Iterator[WorkUnit]) -> Iterable[Outcome]:
        """Carry out all of `blocks`."""


class EngineFactory(Protocol):
    """What makes the engine of a run."""

    def __call__(
        self, commands: Commands, scratch: Path, cases: Path
    ) -> AbstractContextManager[Engine]:
        """Make an engine.

        scratch : a folder that lasts as long as the run
        cases : the folder of built cases, see `harness.processes.case_folder`
        """
