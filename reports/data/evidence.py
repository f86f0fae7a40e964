"""The contents of a result folder, grouped for reports."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from msgspec import to_builtins

from mortarbench.harness import InputError, Record, Verdict
from mortarbench.harness.errors import say, some
from mortarbench.harness.files.reading import read_json
from mortarbench.harness.record import PROVEN, VERIFIED_FACTOR
from mortarbench.harness.results.folder import environment_of, times_compare
from mortarbench.harness.results.journal import read_journal
from mortarbench.harness.running.pairs import Block
from mortarbench.harness.suite.suite import read_stored
from mortarbench.harness.verify.kkt import allowed, rejudged
from mortarbench.reports.statistics.intervals import Interval, median_interval

FROM_FILE = "file"  #: family of QPs from files, whose case names are paths
_MARK_DIGITS = 6  #: number of digits of the digest of a QP in a case name
RESIDUALS = ("primal", "dual", "complementarity", "gap")

_AS_WRITTEN = "the file that the run wrote; restore it"

#: Verdicts, worst first. The verdict of an outcome is the worst verdict of its repeats.
SEVERITY = (
    Verdict.WRONG,
    Verdict.INACCURATE,
    Verdict.INFEASIBLE_CLAIM,
    Verdict.UNBOUNDED_CLAIM,
    Verdict.CRASHED,
    Verdict.FAILED,
    Verdict.MEMORY_LIMIT,
    Verdict.TIME_LIMIT,
    Verdict.ITERATION_LIMIT,
    Verdict.DECLINED,
    *PROVEN,
    Verdict.VERIFIED,
)


def _seconds(r: Record, phase: str) -> float | None:
    seconds: float | None = getattr(r, f"{phase}_seconds")
    return seconds


def _median(seconds: Iterable[float | None]) -> Interval | None:
    """Return the median of the known times with its interval; None if all are None."""
    times = [t for t in seconds if t is not None]
    return median_interval(times) if times else None


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """All repeats of one solver on one case at one tolerance."""

    records: tuple[Record, ...]  #: records of all repeats; at least one
    factor: float = VERIFIED_FACTOR  #: residuals of verified answers are ≤ factor·tol

    @property
    def first(self) -> Record:
        """The first record, for the fields that all repeats share."""
        return self.records[0]

    @property
    def case(self) -> str:
        """Canonical name of the case."""
        return self.first.case

    @property
    def physical(self) -> str:
        """Case name without the form; primal and dual QPs of a problem share it."""
        return self.case.removesuffix(f"/{self.first.form}")

    @property
    def tol(self) -> float:
        """Tolerance given to the solver."""
        return self.first.tol

    @property
    def allowed(self) -> float:
        """Largest residual that verification allows, see `harness.verify.kkt`."""
        return allowed(self.first.judged_at, self.factor)

    @property
    def solver(self) -> str:
        """Label of the solver in the suite."""
        return self.first.solver

    @cached_property
    def verdict(self) -> Verdict:
        """Worst verdict among the repeats."""
        return min((r.status for r in self.records), key=SEVERITY.index)

    @property
    def verified(self) -> bool:
        """True if every repeat was verified."""
        return self.verdict.is_verified

    @cached_property
    def claims(self) -> tuple[str, ...]:
        """Distinct claims of the solver."""
        return tuple(dict.fromkeys(r.claimed for r in self.records if r.claimed))

    @property
    def run_ids(self) -> tuple[str, ...]:
        """Identities of the measurements of this outcome."""
        return tuple(r.identity for r in self.records)

    def largest(self, name: str) -> float | None:
        """Return the largest value of a field; None if a repeat lacks it."""
        values = [getattr(r, name) for r in self.records]
        return None if None in values else float(max(values))

    @cached_property
    def worst(self) -> float | None:
        """Largest of the four residuals; None if one is missing."""
        known = [v for name in RESIDUALS if (v := self.largest(name)) is not None]
        return max(known) if len(known) == len(RESIDUALS) else None

    @cached_property
    def remembered(self) -> bool:
        """True if the solver reused answers, so that its times are not those of solves.

        The methods of this class then return no times.
        """
        return any(r.remembered for r in self.records)

    @property
    def _timed(self) -> tuple[Record, ...]:
        return () if self.remembered else self.records

    def seconds(self, phase: str) -> Interval | None:
        """Return the median prepare, solve or total time, s; None if none is known."""
        return self._intervals[phase]

    @property
    def by_block(self) -> dict[Block, float]:
        """Total time by block (session and repeat), s; unknown times are omitted."""
        return self.seconds_by_block("total")

    def seconds_by_block(self, phase: str) -> dict[Block, float]:
        """Return the time of one phase by block, s; unknown times are omitted."""
        times = {(r.session, r.repeat): _seconds(r, phase) for r in self._timed}
        return {block: t for block, t in times.items() if t}

    @cached_property
    def _intervals(self) -> dict[str, Interval | None]:
        return {
            phase: _median(_seconds(r, phase) for r in self._timed)
            for phase in ("prepare", "solve", "total")
        }

    @cached_property
    def dualising(self) -> Interval | None:
        """Median time of dualisation over builds of the case; None if none is recorded.

        Primal forms have no such time.
        """
        # a set: all measurements on one build record the same time
        return _median({r.dualise_seconds for r in self.records if r.dualise_seconds})

    @cached_property
    def with_dualising(self) -> Interval | None:
        """Median total time including dualisation; None if `dualising` is None."""
        return _median(
            r.total_seconds + r.dualise_seconds
            for r in self._timed
            if r.total_seconds is not None and r.dualise_seconds
        )

    @cached_property
    def iterations(self) -> tuple[int, int] | None:
        """Fewest and most iterations over the repeats; None if not reported."""
        its = [r.iterations for r in self.records if r.iterations is not None]
        return (min(its), max(its)) if its else None

    def counted(self, name: str) -> float | None:
        """Return the mean of a solver count over the repeats; None if one lacks it."""
        values = [v for r in self.records if (v := r.counts.get(name)) is not None]
        whole = len(values) == len(self.records)
        return float(sum(values) / len(values)) if whole else None

    @cached_property
    def quantities(self) -> Mapping[str, Any]:
        """Physical results of the first repeat that has results; empty if none has."""
        return next((r.quantities for r in self.records if r.quantities), {})

    def size(self, *names: str) -> int | None:
        """Return the sum of integer quantities; None if one is absent or no integer."""
        values = [self.quantities.get(name) for name in names]
        return sum(values) if all(isinstance(v, int) for v in values) else None  # type: ignore[arg-type]

    @property
    def energy(self) -> float | None:
        """Potential energy of the recovered answer; None if the case has no energy."""
        value = self.quantities.get("energy")
        return float(value) if isinstance(value, int | float) else None


@dataclass(frozen=True, eq=False, kw_only=True)
class Evidence:
    """Measurements and metadata of a result folder, from which a report is composed.

    Times of different environments must not be compared: reports are composed from the
    parts of the evidence, see `reports.data.environment.by_environment`.
    """

    directory: Path
    records: tuple[Record, ...]  #: judged at `factor`, in the order of the report
    journal: tuple[Record, ...] = ()  #: all journal lines, with their stored verdicts
    environment: Mapping[str, Any] = field(default_factory=dict)
    suite: Mapping[str, Any] = field(default_factory=dict)
    factor: float = VERIFIED_FACTOR  #: residuals of verified answers are ≤ factor·tol
    #: name of the environment, if this is a part of the evidence from a further one
    place: str = ""
    #: names of all further environments of the folder, by digest
    places: Mapping[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the suite; without a stored suite, name of the folder."""
        return str(self.suite.get("name", self.directory.resolve().name))

    @cached_property
    def solvers(self) -> tuple[str, ...]:
        """Solver labels in the order of the suite; unlisted solvers follow by name."""
        present = {r.solver for r in self.records}
        listed = [_label(entry) for entry in self.suite.get("solvers", ())]
        ordered = [*dict.fromkeys(listed), *sorted(present - set(listed))]
        return tuple(s for s in ordered if s in present)

    @cached_property
    def outcomes(self) -> dict[tuple[str, float], dict[str, Outcome]]:
        """Outcomes by (case, tol) and by solver, in the order of the report."""
        grouped: dict[tuple[str, float], dict[str, list[Record]]] = {}
        for r in self.records:
            row = grouped.setdefault((r.case, r.tol), {})
            row.setdefault(r.solver, []).append(r)
        return {
            key: {
                s: Outcome(records=tuple(row[s]), factor=self.factor)
                for s in self.solvers
                if s in row
            }
            for key, row in grouped.items()
        }

    @cached_property
    def flat(self) -> tuple[Outcome, ...]:
        """All outcomes, sorted by case, then tolerance, then solver."""
        return tuple(o for row in self.outcomes.values() for o in row.values())


def read_evidence(
    directory: Path,
    factor: float = VERIFIED_FACTOR,
    *,
    warn: Callable[[str], None] = say,
) -> Evidence:
    """Read a result folder: journal, environment.json and suite.toml.

    factor : residuals of verified answers are ≤ factor·tol; the journal uses 10·tol
    warn : function that receives warnings about repeated lines of the journal and about
        records whose residuals contradict their verdict

    Raises
    ------
    InputError
        If the folder or its measurements are missing, or a file is malformed.

    """
    records = read_journal(directory, warn)
    if not records:
        raise InputError(
            f"{directory}: no measurement in journal/*.jsonl; run a suite first"
        )
    _warn_of_contradictions(directory, records, warn)
    journal = tuple(records)
    environment = _environment(directory / "environment.json")
    suite = directory / "suite.toml"
    records = _one_qp_per_name(
        _one_name_per_qp(_unite_environments(directory, records))
    )
    return Evidence(
        directory=directory,
        journal=journal,
        records=arrange(_judged_and_labelled(r, factor) for r in records),
        environment=environment,
        suite=to_builtins(read_stored(suite)) if os.path.lexists(suite) else {},
        factor=factor,
    )


def _unite_environments(directory: Path, records: list[Record]) -> list[Record]:
    """Replace each environment by the first one with comparable times."""
    representatives: dict[str, Mapping[str, Any]] = {}
    united: dict[str, str] = {}
    for digest in dict.fromkeys(r.environment for r in records):
        united[digest] = digest
        try:
            environment = environment_of(directory, digest)
        except (
            InputError
        ):  # an environment that is not stored is comparable with itself only
            continue
        united[digest] = next(
            (d for d, e in representatives.items() if times_compare(e, environment)),
            digest,
        )
        representatives.setdefault(united[digest], environment)
    return [
        r
        if united[r.environment] == r.environment
        else r.replace(environment=united[r.environment])
        for r in records
    ]


def _one_name_per_qp(records: list[Record]) -> list[Record]:
    """Give cases with equal QPs from several files the case name of the first file."""
    first: dict[str, Record] = {}
    for r in records:
        if r.family == FROM_FILE and r.qp is not None:
            first.setdefault(r.qp, r)
    return [
        r.replace(case=same.case, params=same.params)
        if r.family == FROM_FILE and (same := first.get(r.qp or ""))
        else r
        for r in records
    ]


def _one_qp_per_name(records: list[Record]) -> list[Record]:
    """Add the first digits of the QP to the name and the parameters of further QPs.

    A name denotes several QPs if a default, a file or a plug-in changed between two
    sessions. Rounding errors, and hence digests, differ between environments, which
    have separate tables.
    """
    digests: dict[tuple[str, str], dict[str, None]] = {}
    named = []
    for r in records:
        if r.qp is not None:
            known = digests.setdefault((r.environment, r.case), {})
            known[r.qp] = None
            if r.qp != next(iter(known)):
                mark = r.qp[:_MARK_DIGITS]
                physical = r.case.removesuffix(f"/{r.form}")
                r = r.replace(
                    case=f"{physical}/QP={mark}{r.case.removeprefix(physical)}",
                    params={**r.params, "QP": mark},
                )
        named.append(r)
    return named


def _warn_of_contradictions(
    directory: Path, records: Iterable[Record], warn: Callable[[str], None]
) -> None:
    """Warn about verified records whose residuals are too large for that verdict."""
    wrong = []
    for r in records:
        values = [v for name in RESIDUALS if (v := getattr(r, name)) is not None]
        if r.status is Verdict.VERIFIED and max(values, default=0) > allowed(
            r.judged_at
        ):
            wrong.append(r.identity)
    if wrong:
        warn(
            f"{directory}: residuals of verified records exceed "
            f"{VERIFIED_FACTOR:g} times the tolerance: {some(wrong)}; `run` does not "
            "write such records; judge the points again with `validate`"
        )


def _environment(path: Path) -> dict[str, Any]:
    """Read environment.json; return an empty table if the file does not exist."""
    if not os.path.lexists(path):
        return {}
    table = read_json(path, _AS_WRITTEN)
    if not isinstance(table, dict):
        raise InputError(f"{path}: not a JSON object; expected {_AS_WRITTEN}")
    return table


def _judged_and_labelled(record: Record, factor: float) -> Record:
    """Judge a record at `factor`; append its mode to the label unless it is cold."""
    changes: dict[str, Any] = {}
    if factor != VERIFIED_FACTOR:
        changes["status"] = rejudged(record, factor)
    if record.mode != "cold":
        changes["solver"] = f"{record.solver} ({record.mode})"
    return record.replace(**changes) if changes else record


def case_set(outcomes: Iterable[Outcome], noun: str = "case") -> str:
    """Count the cases of one or two families ("6 cases of beam-ring"), or all cases."""
    of = {o.case: o.first.family for o in outcomes}
    families = Counter(of.values())
    if len(families) > 2:
        return f"{len(of)} {noun}s of {len(families)} families"
    return ", ".join(
        f"{n} {noun}{'s' * (n > 1)} of {family}" for family, n in families.items()
    )


def shared(outcomes: Iterable[Outcome]) -> str:
    """Return forms, tolerances and cases of outcomes in words, for a figure title."""
    answers = list(outcomes)
    forms = sorted({o.first.form for o in answers} - {""})
    tols = sorted({o.tol for o in answers}, reverse=True)
    ends = dict.fromkeys(f"{tol:g}" for tol in (tols[0], tols[-1]))
    parts = [" and ".join(forms)] * bool(forms)
    return ", ".join([*parts, f"tol {' to '.join(ends)}", case_set(answers)])


def arrange(records: Iterable[Record]) -> tuple[Record, ...]:
    """Sort by case, tolerance, solver, repeat and session."""
    return tuple(sorted(records, key=_position))


def _position(r: Record) -> tuple[Any, ...]:
    params = [
        (k, (0, v, "") if isinstance(v, int | float) else (1, 0, str(v)))
        for k, v in r.params.items()
    ]
    return (r.family, params, r.case, -r.tol, r.solver, r.repeat, r.identity)


def _label(entry: Any) -> str:
    """Return the label of one entry of the suite's list of solvers."""
    if isinstance(entry, Mapping):
        return str(entry.get("label", entry.get("name", "")))
    return str(entry)
