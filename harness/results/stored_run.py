"""Access to stored measurements, for repetition and for rebuilding the cases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from mortarbench.harness.errors import InputError
from mortarbench.harness.names import CaseId, assemble, unbuilt
from mortarbench.harness.plugin import Case, Family, Reference, Solver
from mortarbench.harness.record import Record
from mortarbench.harness.registry import SolverSpec, options_of, resolve
from mortarbench.harness.results.folder import environment_of, suite_of
from mortarbench.harness.results.journal import read_journal
from mortarbench.harness.results.work_unit import WorkUnit
from mortarbench.harness.suite.solver_options import NULL_SUFFIX, without_options
from mortarbench.harness.suite.suite import steps_up_to
from mortarbench.harness.verify.verdicts import new_record, plain


@dataclass(frozen=True, eq=False, kw_only=True)
class StoredRun:
    """A stored measurement with the data needed to repeat it."""

    record: Record
    #: records of all repeats of the measurement in its environment, with `record`
    repeats: list[Record]
    #: cases to measure: the case of the measurement, preceded by the earlier steps if
    #: it belongs to a sequence
    cases: tuple[CaseId, ...]
    spec: SolverSpec
    environment: Mapping[str, Any]  #: environment of the measurement
    time_limit: float  #: time limit of a measurement, s
    memory_limit: float  #: memory limit of a measurement, MiB


def open_stored_run(
    folder: Path,
    run_id: str,
    families: Mapping[str, Family],
    solvers: Mapping[str, Solver],
) -> StoredRun:
    """Find a measurement, and look up its case and solver in the current registries.

    run_id : a run_id, or `Record.identity` if several sessions contain the run_id, or
        the first digits of either

    Raises
    ------
    InputError
        If there is no such measurement; if its family, its solver, a key or an option
        is unknown; or if the family refuses the values of the keys.

    """
    records = read_journal(folder)
    record = _find_record(folder, run_id, records)
    environment, suite = environment_of(folder, record.environment), suite_of(folder)
    spec = _find_solver(record, {spec.label: spec for spec in suite.specs()})
    try:
        if record.family not in families:
            raise InputError(f"unknown family {record.family!r}")
        name = assemble(families[record.family], record.params, record.form)
        in_sequence = record.mode != "cold"
        cases = steps_up_to(suite, name, families) if in_sequence else (name,)
        spec = _with_options(record, spec, solvers)
    except InputError as e:
        raise InputError(f"{record.run_id}: {e}{plugins_needed(environment)}") from None
    return StoredRun(
        record=record,
        repeats=[r for r in records if _cell(r) == _cell(record)],
        cases=cases,
        spec=spec,
        environment=environment,
        time_limit=suite.time_limit,
        memory_limit=suite.memory_limit,
    )


def work_unit_of(
    stored: StoredRun,
    solvers: Mapping[str, Solver],
    environment: str,
) -> WorkUnit:
    """Return a work unit whose last measurement repeats a stored one.

    environment : digest of the current environment
    """
    record = stored.record
    turn = tuple(
        new_record(
            name,
            stored.spec,
            options=options_of(resolve(stored.spec, solvers)),
            tol=record.tol,
            repeat=record.repeat,
            environment=environment,
            mode=record.mode,
            accuracy=record.accuracy,
        )
        for name in stored.cases
    )
    return WorkUnit(
        number=0,
        turns=(turn,),
        time_limit=stored.time_limit,
        memory_limit=stored.memory_limit,
    )


def _cell(r: Record) -> tuple[Any, ...]:
    return r.mode, r.case, r.qp, r.solver, r.options, r.tol, r.accuracy, r.environment


def _find_record(folder: Path, name: str, records: Sequence[Record]) -> Record:
    names = [r.identity if "-" in name else r.run_id for r in records]
    for matches in (str.__eq__, str.startswith):
        found = [r for r, n in zip(records, names, strict=True) if matches(n, name)]
        if len(found) == 1 and name:
            return found[0]
        if found and name:
            first = ", ".join(sorted(r.identity for r in found)[:3])
            raise InputError(
                f"{folder} contains {len(found)} measurements whose run_id begins with "
                f"{name!r} ({first}); give more digits, or SESSION-RUN_ID"
            )
    near = get_close_matches(name, [r.run_id for r in records], n=1, cutoff=0.0)
    hint = f"; the nearest is {near[0]}" if near else ""
    count = f"{len(records)} measurement{'s' * (len(records) != 1)}"
    raise InputError(f"unknown run_id {name!r}: {folder} contains {count}{hint}")


def _find_solver(record: Record, specs: Mapping[str, SolverSpec]) -> SolverSpec:
    """Return the spec of the solver that a record's label denotes.

    specs : solvers of the suite by label. Any other label was set by ``--solver`` and
        is the name of a solver
    """
    name = record.solver
    for name in without_options(record.solver.removesuffix(NULL_SUFFIX)):
        if name in specs:
            spec = specs[name]
            break
    else:
        spec = SolverSpec(name=name, label=name)
    return replace(spec, label=record.solver, role=record.arm, ranks=record.ranks)


def _with_options(
    record: Record, spec: SolverSpec, solvers: Mapping[str, Solver]
) -> SolverSpec:
    """Return `spec` with the record's options that differ from current defaults."""
    default = replace(spec, options={})
    if spec.name not in solvers and f"{spec.name.rpartition(':')[0]}:*" not in solvers:
        raise InputError(f"unknown solver {spec.name!r}")
    today = plain(options_of(resolve(default, solvers)))
    options = {k: v for k, v in record.options.items() if today.get(k, ...) != v}
    configured = replace(spec, options=options)
    resolve(configured, solvers)
    return configured


def plugins_needed(environment: Mapping[str, Any]) -> str:
    """Return a hint that a measurement needs plug-ins, for a message, or ""."""
    plugins = environment.get("plugins")
    named = plugins if isinstance(plugins, list | Mapping) else ()
    options = " ".join(f"--plugin {name}" for name in named)
    return f"; it was measured with plug-ins: add {options}" if options else ""


def rebuild(
    r: Record, folder: Path, families: Mapping[str, Family], reference: Reference
) -> Case:
    """Build the case of a record again.

    Raises
    ------
    InputError
        If the family is unknown or raises an exception.

    """
    if r.family not in families:
        try:
            needs = plugins_needed(environment_of(folder, r.environment))
        except InputError:
            needs = ""
        raise InputError(f"unknown family {r.family!r}{needs}")
    name = assemble(families[r.family], r.params, r.form)
    try:
        return name.build(reference)
    except (Exception, SystemExit) as e:  # raised by code of the family
        raise InputError(unbuilt(r.case, e)) from None
