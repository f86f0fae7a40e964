"""Summary of the measurements, and the solvers that miss a tolerance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

from mortarbench.harness import InputError, Verdict
from mortarbench.harness.record import PROVEN, VERIFIED_FACTOR
from mortarbench.harness.results.folder import differences, environment_of
from mortarbench.reports.data.environment import QUIET_LOAD, busy_with, machine
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.document.formatting import ENDINGS, VERDICTS
from mortarbench.reports.document.grouping import grouped
from mortarbench.reports.document.layout import Cell, Part, Point, Table, sources
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.sections import Analysis, section

_GROUPS: dict[str, tuple[Verdict, ...]] = {
    "verified": (Verdict.VERIFIED, *PROVEN),
    "inaccurate": (Verdict.INACCURATE,),
    "wrong": (Verdict.WRONG,),
    "unproven claim": (Verdict.INFEASIBLE_CLAIM, Verdict.UNBOUNDED_CLAIM),
    "limit": (Verdict.ITERATION_LIMIT, Verdict.TIME_LIMIT, Verdict.MEMORY_LIMIT),
    "failed": (Verdict.CRASHED, Verdict.FAILED),
    "declined": (Verdict.DECLINED,),
}
TEXT = Sentences(
    __name__,
    ENDINGS=ENDINGS,
    FACTOR=VERIFIED_FACTOR,
    QUIET_LOAD=QUIET_LOAD,
)


@section(12, "summary", "Summary")
def summary(a: Analysis) -> Iterator[Part]:
    """Summarise the measurements in a few sentences and a table."""
    evidence = a.evidence
    tried = [o for o in evidence.flat if o.verdict is not Verdict.DECLINED]
    yield from TEXT.parts(
        "prose",
        evidence,
        made=_measurement_counts(evidence),
        cases=len({o.case for o in evidence.flat}),
        tols=sorted({o.tol for o in evidence.flat}, reverse=True),
        sessions=len({r.session for r in evidence.records}),
        others=_others(evidence),
        judged=sorted({r.accuracy for r in evidence.records if r.accuracy is not None}),
        load=busy_with(evidence),
        repeats=sorted({len(o.records) for o in tried}),
    )
    for solver in evidence.solvers:
        yield from map(Point, sentences(evidence, solver))
    mine = {s: [r for r in evidence.records if r.solver == s] for s in evidence.solvers}

    def measured(solver: str) -> Cell:
        return Cell.number(sum(r.status is not Verdict.DECLINED for r in mine[solver]))

    def ended(verdicts: tuple[Verdict, ...], solver: str) -> Cell:
        those = [r for r in mine[solver] if r.status in verdicts]
        if not those:
            return Cell.number(0, kind="none")
        symbol, kind = VERDICTS[verdicts[0]][0], verdicts[0].value
        return Cell.number(len(those), symbol=symbol, kind=kind, title=sources(those))

    yield Table.of(
        TEXT("counts_caption"),
        evidence.solvers,
        (
            ("solver", Cell.name),
            ("measurements", measured),
            *((name, partial(ended, verdicts)) for name, verdicts in _GROUPS.items()),
        ),
    )


def _others(evidence: Evidence) -> list[tuple[str, str, list[str]]]:
    """List the further environments: name, machine, and keys that differ."""
    found: list[tuple[str, str, list[str]]] = []
    for digest, place in evidence.places.items():
        try:
            there = environment_of(evidence.directory, digest)
        except InputError:
            found.append((place, "not described in the folder", []))
        else:
            keys = [key for key, *_ in differences(evidence.environment, there)]
            found.append((place, machine(there), keys))
    return found


def _measurement_counts(evidence: Evidence) -> tuple[int, int, int, int]:
    """Return the numbers of measurements: completed, planned, declined and missing.

    If a solver declines a case, the journal has one line for all repeats. If the folder
    contains several environments, the suite does not define what is planned in each.
    """
    made = sum(r.status is not Verdict.DECLINED for r in evidence.records)
    if evidence.places:
        declined = len(evidence.records) - made
        return made, made + declined, declined, 0
    asked = evidence.suite.get("repeats")
    most = max(len(o.records) for o in evidence.flat)
    repeats = asked if isinstance(asked, int) and asked > 0 else most
    tried = [o for o in evidence.flat if o.verdict is not Verdict.DECLINED]
    taken = sum(max(repeats, len(o.records)) for o in tried)
    declined = (len(evidence.flat) - len(tried)) * repeats
    total = taken + declined + (_cells(evidence) - len(evidence.flat)) * repeats
    return made, total, declined, total - made - declined


def _cells(evidence: Evidence) -> int:
    """Count the planned combinations of case, tolerance and solver.

    Every solver is planned on the cases of its mode (cold or a sequence).
    """
    modes = {r.solver: r.mode for r in evidence.records}
    rows = evidence.outcomes.values()
    present = [{o.first.mode for o in row.values()} for row in rows]
    return sum(
        modes[solver] in of_case for of_case in present for solver in evidence.solvers
    )


def sentences(evidence: Evidence, solver: str) -> list[str]:
    """Return one sentence per tolerance on the verdicts of a solver."""
    mine = [o for o in evidence.flat if o.solver == solver]
    tols = sorted({o.tol for o in mine}, reverse=True)
    return [_sentence(solver, tol, [o for o in mine if o.tol == tol]) for tol in tols]


def _sentence(solver: str, tol: float, outcomes: Sequence[Outcome]) -> str:
    by_verdict = grouped(outcomes, lambda o: o.verdict)
    declined = by_verdict.get(Verdict.DECLINED, [])
    tried = [o for o in outcomes if o.verdict is not Verdict.DECLINED]
    bounds = [bound for o in tried if (bound := o.largest("energy_bound")) is not None]
    unclaimed = (
        not any(r.claims_answer for r in o.records) for o in tried if o.verified
    )
    return TEXT(
        "solver",
        solver,
        tol,
        tried,
        missed={
            verdict: (those, [o.worst for o in those if o.worst is not None])
            for verdict in ENDINGS
            if (those := by_verdict.get(verdict))
        },
        worst=max((o.worst or 0.0 for o in tried), default=0.0),
        bounds=bounds,
        unclaimed=sum(unclaimed),
        declined=declined,
        reasons=list(
            dict.fromkeys(o.first.message for o in declined if o.first.message)
        ),
    )
