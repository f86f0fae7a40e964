"""Claims, verdicts, iterations and residuals of every case and solver."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from functools import partial

from mortarbench.harness import Verdict
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
from mortarbench.reports.document.formatting import clean, fixed, plain_value, power
from mortarbench.reports.document.layout import Cell, Column, Part, Table, sources
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.sections import Analysis, section
from mortarbench.reports.statistics.profiles import share

TEXT = Sentences(__name__)
#: (claimed to be solved, verified) → heading of the column
KINDS = {
    (True, True): "claimed, verified",
    (True, False): "claimed, refuted",
    (False, True): "verified, not claimed",
    (False, False): "neither",
}


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
    """Tabulate claims and verdicts; list refuted and unproven claims."""
    yield from TEXT.parts("claims")
    yield grid(a.evidence, "Verdicts and worst residuals.", _verdict)
    refuted = [o for o in a.evidence.flat if o.verdict in REFUTED]
    if refuted:
        columns = (
            *answer_columns(),
            ("verdict", verdict_cell),
            ("evidence", _refutation),
            ("message of the solver", lambda o: Cell.label(o.first.message, 60)),
        )
        caption = TEXT("refuted_caption")
        yield Table.of(caption, refuted, columns, text_columns=2)


def _refutation(outcome: Outcome) -> Cell:
    """Return a cell with the residual or distance that is too large, and its limit."""
    values = {name: outcome.largest(name) for name in RESIDUALS}
    errors = {name: value for name, value in values.items() if value is not None}
    if not errors:
        return Cell(text="no point", title=source(outcome))
    name = max(errors, key=lambda n: errors[n])
    text = f"{name} {power(errors[name])} > {power(outcome.allowed)}"
    return Cell(text=text, title=source(outcome))


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
