"""A suite, measured: the schedule, resumption, and one journal line per measurement.

One block is every solver once on one case at one tolerance, in random order, so that a
drift of the machine hits all alike and solvers are compared within a block. The parent
builds a case once, hands its QP to the workers by file, and judges what they return.
"""

from __future__ import annotations

import logging
import random
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any, Protocol

from harness.build import build, unbuilt
from harness.errors import InputError
from harness.folder import claim, locked, refuse_foreign, scratch_in
from harness.journal import Journal, read_journal
from harness.judge import blank, has_point, noted
from harness.names import CaseName, canonical
from harness.plugin import Case, Family, Reference, Solver
from harness.qpfile import qp_digest
from harness.record import Record, Verdict
from harness.registry import SolverSpec, options_of
from harness.remote import hand_over, measured
from harness.solution import Solution
from harness.store import save_fields, save_solution
from harness.suite import Suite
from harness.supervisor import WorkerProcess

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


@dataclass(frozen=True, eq=False, kw_only=True)
class _Entrant:
    spec: SolverSpec
    options: Mapping[str, Any]
    worker: WorkerProcess


@dataclass(frozen=True, eq=False, kw_only=True)
class _Bench:
    """What every measurement of a run needs."""

    suite: Suite
    families: Mapping[str, Family]
    reference: Reference
    entrants: list[_Entrant]
    out: Path
    scratch: Path
    journal: Journal
    past: list[Record]  #: measured by earlier runs
    blocks: Iterator[int]  #: numbers not used yet
    digest: str
    progress: Progress


Cell = tuple[_Entrant, Record]  #: who, and the record to fill in


def run(
    suite: Suite,
    *,
    families: Mapping[str, Family],
    reference: Reference,
    out: Path,
    command: Callable[[SolverSpec], list[str]],
    resolve: Callable[[SolverSpec], Solver],
    environment: Mapping[str, Any],
    digest: str,
    progress: Progress,
    fresh: bool = False,
) -> list[str]:
    """Measure what the result folder `out` lacks of `suite`, in worker processes.

    Returns the names of the cases that could not be built: they have no records, so
    that the same command tries them again.

    reference : the injected high-accuracy solve that families may build with
    command : starts the worker of a solver; two file descriptors are appended to it
    resolve : configures the solver, whose options go into the records
    environment, digest : what to write into environment.json, and its digest
    fresh : forget first what `out` holds

    Raises
    ------
    InputError
        When `out` is no result folder, holds another suite, case or environment, or is
        in use. Any other failure costs the measurements it concerns.

    """
    refuse_foreign(out)
    with locked(out), ExitStack() as stack:
        claim(out, suite, {"digest": digest, **environment}, fresh=fresh)
        scratch = stack.enter_context(scratch_in(out))
        journal = stack.enter_context(Journal(out, digest))
        past = read_journal(out)
        _check_same(out, past, suite, families)
        entrants = [
            _Entrant(
                spec=spec,
                options=options_of(resolve(spec)),
                worker=WorkerProcess(command(spec), scratch / f"worker-{i}.log"),
            )
            for i, spec in enumerate(suite.solvers)
        ]
        for entrant in entrants:
            stack.callback(entrant.worker.close)
        bench = _Bench(
            suite=suite,
            families=families,
            reference=reference,
            entrants=entrants,
            out=out,
            scratch=scratch,
            journal=journal,
            past=past,
            blocks=count(1 + max((r.block for r in past), default=-1)),
            digest=digest,
            progress=progress,
        )
        cells = len(suite.cases) * len(suite.tolerances) * suite.repeats * len(entrants)
        progress.start(cells)
        failed = [name for name in suite.cases if not _run_case(bench, name)]
        return [canonical(name, families[name.family]) for name in failed]


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


def _run_case(bench: _Bench, name: CaseName) -> bool:
    """Measure the cells of one case that are not in the journal; False if unbuilt."""
    blocks = [block for block in _blocks(bench, name) if block]
    if not blocks:
        return True
    family = bench.families[name.family]
    canonical_name = canonical(name, family)
    bench.progress.say(f"building {canonical_name}")
    try:
        case = build(name, family, bench.reference)
    except (Exception, SystemExit) as e:  # the family's code
        _log.debug("%s could not be built", canonical_name, exc_info=True)
        bench.progress.warn(unbuilt(canonical_name, e))
        for _ in chain.from_iterable(blocks):
            bench.progress.advance(None)
        return False
    qp_file = hand_over(case, canonical_name, bench.scratch)
    digest = qp_digest(case.qp)
    declined: set[tuple[str, float]] = set()
    for block in blocks:
        number = next(bench.blocks)
        for entrant, record in block:
            if (record.solver, record.tol) in declined:  # it will again: say it once
                bench.progress.advance(None)
                continue
            bench.progress.say(f"{record.solver} on {record.case}")
            record, solution = measured(
                entrant.worker,
                case,
                qp_file,
                record,
                time_limit=bench.suite.time_limit,
                memory_limit=bench.suite.memory_limit,
            )
            if solution is not None:
                record = _stored(bench.out, case, record, solution)
            record = record.but(block=number, qp=digest)
            bench.journal.append(record)
            bench.progress.advance(record)
            if record.status is Verdict.DECLINED:
                declined.add((record.solver, record.tol))
    return True


def _blocks(bench: _Bench, name: CaseName) -> Iterator[list[Cell]]:
    """Yield per tolerance and repeat what is still to be measured, shuffled."""
    suite = bench.suite
    case = canonical(name, bench.families[name.family])
    past = [r for r in bench.past if r.case == case]
    done = {r.run_id for r in past}
    declined = {(r.solver, r.tol) for r in past if r.status is Verdict.DECLINED}
    for tol in suite.tolerances:
        for repeat in range(suite.repeats):
            block = []
            for entrant in bench.entrants:
                record = blank(
                    name,
                    case,
                    entrant.spec,
                    options=entrant.options,
                    tol=tol,
                    repeat=repeat,
                    environment=bench.digest,
                )
                if record.run_id in done or (record.solver, tol) in declined:
                    bench.progress.advance(None)
                else:
                    block.append((entrant, record))
            random.Random(f"{suite.name} {case} {tol} {repeat}").shuffle(block)
            yield block


def _stored(out: Path, case: Case, record: Record, solution: Solution) -> Record:
    """Store the point and, of a first verified repeat, the deformed state."""
    if not has_point(solution):
        return record
    record = record.but(vectors=save_solution(out, solution))
    if record.status is not Verdict.VERIFIED or record.repeat or case.fields is None:
        return record
    try:
        fields = case.fields(solution)
    except Exception as e:  # the family's code; its fault must not lose the record
        return noted(record, "fields", e)
    return record.but(fields=save_fields(out, fields))
