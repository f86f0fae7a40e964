"""What was measured, and which solvers do not reach what was asked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from mortarbench.harness import InputError, Record, Verdict
from mortarbench.harness.record import SCHEMA, VERIFIED_FACTOR
from mortarbench.harness.results.faults import in_words
from mortarbench.harness.results.folder import differences, environment_of
from mortarbench.reports.data.environment import QUIET_LOAD, busy_with, machine
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.document.formatting import (
    ENDINGS,
    VERDICTS,
    clean,
    listing,
    plural,
    power,
    tolerance,
)
from mortarbench.reports.document.layout import Cell, Section, Table, name_cell, sources

_LIMITS = (Verdict.ITERATION_LIMIT, Verdict.TIME_LIMIT, Verdict.MEMORY_LIMIT)
_GROUPS: dict[str, tuple[Verdict, ...]] = {
    "verified": (Verdict.VERIFIED, Verdict.VERIFIED_INFEASIBLE),
    "inaccurate": (Verdict.INACCURATE,),
    "wrong": (Verdict.WRONG,),
    "infeasible claim": (Verdict.INFEASIBLE_CLAIM,),
    "limit": _LIMITS,
    "failed": (Verdict.CRASHED, Verdict.FAILED),
    "declined": (Verdict.DECLINED,),
}


def summary(evidence: Evidence) -> Section:
    """Say in a few sentences and one table how the comparison ended."""
    cases = len({o.case for o in evidence.flat})
    tols = sorted({o.tol for o in evidence.flat}, reverse=True)
    prose = [
        f"{_made(evidence)}: "
        f"{plural(len(evidence.solvers), 'solver')}, {plural(cases, 'case')}, "
        f"tolerance {', '.join(map(tolerance, tols))}. What a solver says of its "
        "answer is recorded beside our verdict: every verdict below comes from "
        "residuals that we evaluated at the returned point, or for small QPs from a "
        "proven optimum, and only verified answers enter a comparison of times.",
    ]
    digests = sorted({r.environment for r in evidence.records})
    if len(digests) > 1:
        prose.append(
            f"Warning: the measurements come from {len(digests)} different "
            f"environments ({listing(digests)}); their times are not comparable."
            f"{_marked(evidence)}"
        )
    notes = (
        _unmade(evidence), _judged(evidence), _at_factor(evidence), _schemas(evidence),
        _busy(evidence), _unequal(evidence),
    )  # fmt: skip
    prose += [text for text in notes if text]
    points = [s for solver in evidence.solvers for s in sentences(evidence, solver)]
    return Section(
        name="summary",
        title="Summary",
        prose=tuple(prose),
        points=tuple(points),
        tables=(_counts(evidence),),
    )


def _marked(evidence: Evidence) -> str:
    """Say what the marks behind labels mean, and what differs there."""
    said = []
    for digest, mark in evidence.marks.items():
        try:
            there = environment_of(evidence.directory, digest)
        except InputError:
            said.append(f"{mark.strip()} is {clean(digest)}")
            continue
        keys = [key for key, *_ in differences(evidence.environment, there)]
        other = f" (other: {listing(keys)})" * bool(keys)
        said.append(f"{mark.strip()} is {clean(machine(there))}{other}")
    if not said:
        return ""
    return (
        f" The same was measured in several: behind a solver's name, {'; '.join(said)}."
    )


def _made(evidence: Evidence) -> str:
    """Count the measurements made, those that a solver declined, and those missing.

    The journal holds one line for a case that a solver declined, whatever the repeats.
    """
    made = sum(r.verdict is not Verdict.DECLINED for r in evidence.records)
    repeats = _repeats(evidence)
    declined = sum(o.verdict is Verdict.DECLINED for o in evidence.flat)
    cells = _cells(evidence)
    taken = sum(
        max(repeats, len(o.records))
        for o in evidence.flat
        if o.verdict is not Verdict.DECLINED
    )
    total = taken + (cells - len(evidence.flat) + declined) * repeats
    text = f"{plural(made, 'measurement')}"
    if total == made:
        return text
    text += f" of the {total} that the suite has on these cases"
    if declined:
        text += f", {declined * repeats} not made because a solver declined"
    missing = total - made - declined * repeats
    return f"{text}, {missing} not made yet" if missing else text


def _unmade(evidence: Evidence) -> str:
    """Say which measurements faults of ours or of the machine prevented."""
    text = in_words(evidence.faults)
    return f"{clean(text, 400)}. The same command tries them again." if text else ""


def _cells(evidence: Evidence) -> int:
    """Count what can be measured: cold solvers on cold cases, sequences on theirs."""

    def kind(r: Record) -> tuple[str, str]:
        return r.mode, evidence.marks.get(r.environment, "")

    kinds = {r.solver: kind(r) for r in evidence.records}
    rows = evidence.outcomes.values()
    present = [{kind(o.first) for o in row.values()} for row in rows]
    return sum(
        kinds[solver] in of_case for of_case in present for solver in evidence.solvers
    )


def _repeats(evidence: Evidence) -> int:
    """Repeats that the suite asks for, or else the most that were made."""
    asked = evidence.suite.get("repeats")
    most = max(len(o.records) for o in evidence.flat)
    return asked if isinstance(asked, int) and asked > 0 else most


def _judged(evidence: Evidence) -> str:
    """Say so if answers were judged at another accuracy than was asked for: a sweep."""
    at = sorted({r.accuracy for r in evidence.records if r.accuracy is not None})
    if not at:
        return ""
    return (
        f"The tolerances are what the solvers were asked for; verified means accurate "
        f"to {listing([tolerance(a) for a in at])} whatever was asked for."
    )


def _at_factor(evidence: Evidence) -> str:
    """Say so if verdicts are not those that the journal holds."""
    if evidence.factor == VERIFIED_FACTOR:
        return ""
    return (
        f"Verdicts here are those at {evidence.factor:g} × tolerance, recomputed from "
        f"the stored claims and residuals; the journal holds those at "
        f"{VERIFIED_FACTOR:g} × tolerance."
    )


def _schemas(evidence: Evidence) -> str:
    """Say so where residuals were measured as an older version defined them."""
    old = {r.schema for r in evidence.records} - {SCHEMA}
    if not old:
        return ""
    return (
        "Some or all residuals are those of an older definition (journal schema "
        f"{listing([str(s) for s in sorted(old)])}, now {SCHEMA}); their verdicts are "
        "read as they were meant then."
    )


def _busy(evidence: Evidence) -> str:
    """Warn of a machine that other programs used when the measurements began."""
    load = busy_with(evidence)
    if load is None:
        return ""
    return (
        f"Warning: the machine was not idle when the measurements began (load average "
        f"{load:.2f}; quiet is at most {QUIET_LOAD}): times may be too long, and their "
        "scatter is not that of the solvers alone."
    )


def _unequal(evidence: Evidence) -> str:
    """Say so if some cells were repeated more often than others."""
    tried = [o for o in evidence.flat if o.verdict is not Verdict.DECLINED]
    counts = {len(o.records) for o in tried}
    if len(counts) < 2:
        return ""
    return (
        f"Numbers of repeats are unequal: {min(counts)} to {max(counts)} for one "
        "solver on one case; intervals of different numbers cover differently."
    )


def _counts(evidence: Evidence) -> Table:
    rows = []
    for solver in evidence.solvers:
        mine = [r for r in evidence.records if r.solver == solver]
        count = Counter(r.verdict for r in mine)
        made = len(mine) - count[Verdict.DECLINED]
        row = [name_cell(solver), Cell(text=str(made), value=made)]
        for verdicts in _GROUPS.values():
            those = [r for r in mine if r.verdict in verdicts]
            n = len(those)
            symbol, _ = VERDICTS[verdicts[0]]
            kind, symbol = (verdicts[0].value, symbol) if n else ("none", "")
            row.append(
                Cell(
                    text=str(n), symbol=symbol, kind=kind, value=n, title=sources(those)
                )
            )
        rows.append(tuple(row))
    return Table(
        caption="Measurements by verdict. Verified: optimal points, and proven claims "
        "of infeasibility. Inaccurate and wrong: the solver claimed "
        "success and its point refutes the claim. Declined: cases that were not "
        "measured, at one tolerance each; they are not among the measurements.",
        columns=("solver", "measurements", *_GROUPS),
        rows=tuple(rows),
    )


def sentences(evidence: Evidence, solver: str) -> list[str]:
    """Say plainly where one solver does not reach the tolerance, one per tolerance."""
    mine = [o for o in evidence.flat if o.solver == solver]
    name = clean(solver, 40)
    said = []
    for tol in sorted({o.tol for o in mine}, reverse=True):
        at_tol = [o for o in mine if o.tol == tol]
        tried = [o for o in at_tol if o.verdict is not Verdict.DECLINED]
        missed = _missed(tried, tol) if tried else []
        if tried and not missed:
            worst = max((o.worst or 0.0 for o in tried), default=0.0)
            missed = [
                f"verified on {_all(len(tried))} at tol "
                f"{tolerance(tol)}{_early(tried)}; worst residual {power(worst)}"
                f"{_certified(tried)}"
            ]
        missed += _unclaimed(tried) + _declined(at_tol)
        said.append(f"{name}: {'; '.join(missed)}.")
    return said


def _early(tried: Sequence[Outcome]) -> str:
    """Say that early steps of a sequence had looser tolerances, where they had."""
    loosest = max((o.first.step_tol or 0.0 for o in tried), default=0.0)
    return f", early steps at up to {tolerance(loosest)}" if loosest else ""


def _certified(tried: Sequence[Outcome]) -> str:
    """Say how accurate the answers are for sure, where all that can be is certified."""
    bounds = [o.largest("energy_bound") for o in tried]
    known = [bound for bound in bounds if bound is not None]
    if not known:
        return ""
    of = "" if len(known) == len(tried) else f" of the {len(known)} that have a bound"
    return f", certified energy error{of} at most {power(max(known))}"


def _all(count: int) -> str:
    return f"all {count} cases" if count > 1 else "its only case"


def _missed(tried: Sequence[Outcome], tol: float) -> list[str]:
    """Say how many cases ended in each verdict other than verified, and which."""
    said = []
    for verdict in ENDINGS:
        those = [o for o in tried if o.verdict is verdict]
        if not those:
            continue
        known = [o.worst for o in those if o.worst is not None]
        worst = f"worst residual {power(max(known))}, " if known else ""
        said.append(
            f"{len(those)} of {plural(len(tried), 'case')} {ENDINGS[verdict]} at tol "
            f"{tolerance(tol)} ({worst}on {listing([o.case for o in those])})"
        )
    return said


def _unclaimed(tried: Sequence[Outcome]) -> list[str]:
    """Count the verified answers that the solver itself did not call solved."""
    n = sum(o.verified and not any(r.claims_answer for r in o.records) for o in tried)
    return [f"{plural(n, 'verified answer')} not claimed to be solved"] if n else []


def _declined(outcomes: Sequence[Outcome]) -> list[str]:
    """Say what a solver declined, and why in its own words."""
    those = [o for o in outcomes if o.verdict is Verdict.DECLINED]
    reasons = list(dict.fromkeys(o.first.message for o in those if o.first.message))
    why = f": {listing(reasons, 2)}" if reasons else ""
    return [f"declined {plural(len(those), 'case')}{why}"] if those else []
