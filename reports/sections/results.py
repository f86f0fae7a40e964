"""Claims, verdicts, iterations and residuals of every case and solver."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from mortarbench.harness import Record, Verdict
from mortarbench.harness.record import PROVEN, REFUTED
from mortarbench.reports.data.cells import (
    answer_columns,
    case_cells,
    grid,
    iterations_cell,
    source,
    verdict_cell,
)
from mortarbench.reports.data.evidence import RESIDUALS, Outcome
from mortarbench.reports.data.quantities import best_of
from mortarbench.reports.document.formatting import (
    ENDINGS,
    clean,
    fixed,
    plain_value,
    power,
)
from mortarbench.reports.document.grouping import grouped
from mortarbench.reports.document.layout import (
    Cell,
    Column,
    Part,
    Point,
    Table,
    sources,
)
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.sections import Analysis, section
from mortarbench.reports.statistics.profiles import share

TEXT = Sentences(__name__, ENDINGS=ENDINGS)
#: (claimed to be solved, verified) → heading of the column
KINDS = {
    (True, True): "claimed, verified",
    (True, False): "claimed, refuted",
    (False, True): "verified, not claimed",
    (False, False): "neither",
}
_MESSAGE = 160  #: largest number of characters of a message
_REASONS = 20  #: largest number of reasons in the list of answers without a claim


@section(16, "tally", "Claims and verdicts: counts")
def claim_counts(a: Analysis) -> Iterator[Part]:
    """Count the answers of every solver by claim and verdict."""
    count: dict[str, Counter[tuple[bool, bool]]] = defaultdict(Counter)
    for o in a.evidence.flat:
        if o.verdict is not Verdict.DECLINED:
            claimed = o.claims == ("solved",) or all(r.claims_answer for r in o.records)
            count[o.solver][claimed, o.verified] += 1

    def counted(kind: tuple[bool, bool], solver: str) -> Cell:
        n = count[solver][kind]
        return Cell.number(n, kind="over" if n and kind == (True, False) else "")

    def confirmed(solver: str) -> Cell:
        right, wrong = count[solver][True, True], count[solver][True, False]
        if not right + wrong:
            return Cell()
        estimate = [float(part) for part in share(right, right + wrong)]
        return Cell(text=fixed(estimate, 2), value=estimate[0])

    yield from TEXT.parts("claim_counts")
    yield Table.of(
        "Claims of the solvers and our verdicts.",
        a.evidence.solvers,
        (
            ("solver", Cell.name),
            *((name, partial(counted, kind)) for kind, name in KINDS.items()),
            ("claims that hold", confirmed),
        ),
    )


@section(18, "verdicts", "Claims and verdicts")
def claims(a: Analysis) -> Iterator[Part]:
    """Tabulate claims and verdicts; state why answers are not verified."""
    yield from TEXT.parts("claims")
    yield grid(a.evidence, "Verdicts and worst residuals.", _verdict)
    ended = [
        _Ended.of(o, row)
        for row in a.evidence.outcomes.values()
        for o in row.values()
        if not o.verified and o.verdict is not Verdict.DECLINED
    ]
    alike = grouped(
        ended, lambda e: (e.record.solver, e.record.tol, e.record.status, e.why)
    )
    refuted = [of for of in alike.values() if of[0].record.status in REFUTED]
    if refuted:
        columns = (
            ("case", _cases),
            *answer_columns(lambda of: of[0].outcome)[1:],
            ("verdict", lambda of: verdict_cell(of[0].outcome)),
            ("evidence", _refutation),
            (
                "message of the solver",
                lambda of: Cell.label(of[0].record.message, _MESSAGE),
            ),
        )
        caption = TEXT("refuted_caption")
        yield Table.of(caption, refuted, columns, text_columns=2)
    others = [of for of in alike.values() if of[0].record.status not in REFUTED]
    others.sort(key=len, reverse=True)
    yield from (Point(TEXT("ended", of[0], len(of))) for of in others[:_REASONS])
    if len(others) > _REASONS:
        yield Point(TEXT("more", len(others) - _REASONS))


class _Ended(NamedTuple):
    """An answer that is not verified, and the reasons."""

    outcome: Outcome
    record: Record  #: first repeat with the verdict of the outcome
    reason: str  #: largest error, and the difference of the objective; empty if unknown

    @property
    def why(self) -> str:
        """Reason and message in one line."""
        message = clean(self.record.message, _MESSAGE)
        return "; ".join(filter(None, (self.reason, message))) or "no point"

    @classmethod
    def of(cls, o: Outcome, row: Mapping[str, Outcome]) -> _Ended:
        """State why an answer is not verified.

        The objective is compared with that of the most accurate verified answer in the
        row. It is mentioned if the difference, relative to the larger absolute value,
        exceeds the largest residual that verification allows.

        row : outcomes of all solvers on the same case at the same tolerance
        """
        record = next(r for r in o.records if r.status is o.verdict)
        errors = {name: o.largest(name) for name in RESIDUALS}
        known = [(value, name) for name, value in errors.items() if value is not None]
        if not known:
            return cls(o, record, "")
        error, name = max(known, key=lambda each: each[0])
        reason = f"{name} {power(error)} > {power(o.allowed)}"
        peers = [p for p in row.values() if p.verdict is Verdict.VERIFIED]
        mine = record.objective
        theirs = best_of(peers).first.objective if peers else None
        if mine is not None and theirs is not None:
            apart, size = mine - theirs, max(abs(mine), abs(theirs))
            if abs(apart) > o.allowed * size:
                side = "above" if apart > 0 else "below"
                gap = f"{power(abs(apart) / size)} {side} that of the other solvers"
                reason = f"{reason}; the objective is {gap}"
        return cls(o, record, reason)


def _cases(alike: Sequence[_Ended]) -> Cell:
    """Return a cell with the first case, and the number of answers with this result."""
    cell, count = Cell.name(alike[0].outcome.case), len(alike)
    return replace(cell, after=f"the same in {count} answers" if count > 1 else "")


def _refutation(alike: Sequence[_Ended]) -> Cell:
    title = source(*(e.outcome for e in alike))
    return Cell(text=alike[0].reason or "no point", title=title)


def _verdict(outcome: Outcome, _row: Mapping[str, Outcome]) -> Cell:
    after = [power(outcome.worst)] if outcome.worst is not None else []
    refuted = outcome.verdict in (Verdict.INACCURATE, Verdict.WRONG)
    expected = "solved" if outcome.verified or refuted else outcome.verdict.value
    if outcome.verdict in PROVEN:
        expected = outcome.verdict.value.removeprefix("verified_")
    claimed = [c for c in outcome.claims if c != expected]
    if claimed and outcome.verdict is not Verdict.DECLINED:
        after.append("claimed " + clean(", ".join(claimed).replace("_", " "), 40))
    return verdict_cell(outcome, ", ".join(after), clean(outcome.first.message, 240))


@section(50, "iterations", "Iterations and counts")
def iterations(a: Analysis) -> Iterator[Part]:
    """Tabulate iterations, and the further counts of each solver."""
    yield from TEXT.parts("iterations")
    caption = "Iterations, as counted by the solvers."
    yield grid(a.evidence, caption, _iterations)
    for solver in a.evidence.solvers:
        mine = [o for o in a.evidence.flat if o.solver == solver and o.first.counts]
        if names := dict.fromkeys(k for o in mine for k in o.first.counts):
            heads = (clean(name.replace("_", " "), 40) for name in names)
            yield Table(
                caption=f"Counts of {clean(solver, 40)} in the first repeat.",
                columns=("case", "tol", *heads),
                rows=tuple((*case_cells(o), *_counts(o, names)) for o in mine),
                solver=solver,
            )


def _iterations(outcome: Outcome, _row: Mapping[str, Outcome]) -> Cell:
    if outcome.verified:
        return iterations_cell(outcome)
    return iterations_cell(outcome, "({})", "quiet")


def _counts(outcome: Outcome, names: Iterable[str]) -> Iterator[Cell]:
    for name in names:
        n = outcome.first.counts.get(name)
        if n is None:
            yield Cell()
        else:
            value = float(n) if isinstance(n, int | float) else None
            title = sources([outcome.first])
            yield Cell(text=plain_value(n, 24), value=value, title=title)


@section(56, "errors", "Errors")
def errors(a: Analysis) -> Iterator[Part]:
    """Tabulate the four residuals and, if available, the certified error bound."""
    answers = [o for o in a.evidence.flat if o.worst is not None]
    bounded = any(o.largest("energy_bound") is not None for o in a.evidence.flat)
    yield from TEXT.parts("errors", answers, bounded)

    def residual(name: str, o: Outcome) -> Cell:
        value = o.largest(name)
        over = value is not None and value > o.allowed and name in RESIDUALS
        return Cell.power(value, kind="over" if over else "", title=source(o))

    if answers:
        columns: tuple[Column, ...] = (
            *answer_columns(),
            ("verdict", verdict_cell),
            *(
                (name.replace("_", " "), partial(residual, name))
                for name in (*RESIDUALS, *("energy_bound",) * bounded)
            ),
        )
        caption = "Residuals of every answer."
        yield Table.of(caption, answers, columns, text_columns=2)
