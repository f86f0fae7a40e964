"""Verdicts, times, iterations and residuals of every case and solver."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from harness import Verdict
from harness.kkt import VERIFIED_FACTOR
from reports.data import RESIDUALS, Evidence, Outcome
from reports.intervals import COVERAGE, Interval
from reports.layout import Cell, Section, Table, case_cells, source, verdict_cell
from reports.wording import ABSENT, TIMED, VERDICTS, clean, power, seconds, span


def claims(evidence: Evidence) -> Section:
    """Set what each solver claimed beside what we found."""
    return Section(
        name="verdicts",
        title="Claimed against verified",
        prose=(
            "Our verdict on each answer, with the largest of its four residuals. What "
            "the solver said of itself is added where it differs from the verdict; "
            "inaccurate and wrong answers were claimed to be solved.",
        ),
        tables=(
            _grid(evidence, "Verdicts and worst residuals.", _verdict),
            *_refuted(evidence),
        ),
    )


def _refuted(evidence: Evidence) -> list[Table]:
    """List every claim that our evaluation refutes, with what refutes it."""
    refuted = [
        o for o in evidence.flat
        if o.verdict in (Verdict.INACCURATE, Verdict.WRONG, Verdict.INFEASIBLE_CLAIM)
    ]  # fmt: skip
    if not refuted:
        return []
    return [
        Table(
            caption="Refuted claims: what the solver said, and the residual that says "
            "otherwise, with what verification allows.",
            columns=("case", "solver", "tol", "verdict", "evidence", "its words"),
            rows=tuple(_refutation(o) for o in refuted),
            text_columns=2,
        )
    ]


def _refutation(outcome: Outcome) -> tuple[Cell, ...]:
    """Make one row of the table of refuted claims."""
    allowed = min(VERIFIED_FACTOR * outcome.tol, 0.1)
    values = {name: outcome.largest(name) for name in RESIDUALS}
    known = {name: v for name, v in values.items() if v is not None}
    name = max(known, key=lambda n: known[n], default=None)
    evidence = (
        "no point"
        if name is None
        else f"{name} {power(known[name])} > {power(allowed)}"
    )
    case, tol = case_cells(outcome)
    return (
        case,
        Cell(text=clean(outcome.solver, 40)),
        tol,
        verdict_cell(outcome),
        Cell(text=evidence, title=source(outcome)),
        Cell(text=clean(outcome.first.message, 60)),
    )


def _verdict(outcome: Outcome, _row: Mapping[str, Outcome]) -> Cell:
    after = [power(outcome.worst)] if outcome.worst is not None else []
    refuted = outcome.verdict in (Verdict.INACCURATE, Verdict.WRONG)
    expected = "solved" if outcome.verified or refuted else outcome.verdict.value
    claimed = [c for c in outcome.claims if c != expected]
    if claimed and outcome.verdict is not Verdict.DECLINED:
        after.append("claimed " + clean(", ".join(claimed).replace("_", " "), 40))
    cell = verdict_cell(outcome, ", ".join(after))
    message = clean(outcome.first.message, 240)
    return Cell(**{**vars(cell), "title": f"{message} · {cell.title}".lstrip(" ·")})


def times(evidence: Evidence) -> Section:
    """Compare the total times of verified answers."""
    intervals = [o.seconds("total") for o in evidence.flat]
    return Section(
        name="times",
        title="Times",
        prose=(
            "Median of prepare + solve over the repeats, each prepared afresh, and in "
            "brackets an interval for the median.",
            _coverage(intervals),
            "Bold: the fastest verified answer of its row; ≈: verified, and its "
            "interval overlaps that of the fastest, so that this run does not tell "
            f"them apart.{_weakness(intervals)} Struck out: the answer was not "
            "verified, so its time is no result.",
        ),
        tables=(_grid(evidence, f"Total time, median and interval. {TIMED}", _time),),
    )


def _coverage(intervals: list[Interval | None]) -> str:
    """State what the brackets mean for each number of repeats that occurs."""
    known = {i.samples: i.coverage for i in intervals if i is not None}
    stated = ", ".join(
        f"{coverage:.3g} for {n} repeats"
        for n, coverage in sorted(known.items())
        if n > 1
    )
    if not stated:
        return "A single run says nothing of its uncertainty."
    return (
        "The interval runs between order statistics (below six repeats: the smallest "
        "and the largest) and holds the true median, whatever the distribution, with "
        f"probability {stated}; this presumes repeats that are independent and "
        "identically distributed, which those on a busy machine are not."
    )


def _weakness(intervals: list[Interval | None]) -> str:
    """Say how little an order of times means where an interval covers too rarely."""
    known = [i for i in intervals if i is not None and i.samples > 1]
    weakest = min(known, key=lambda i: i.coverage, default=None)
    if weakest is None or weakest.coverage >= COVERAGE:
        return ""
    return (
        f" That is a weak test: with {weakest.samples} repeats an interval misses the "
        f"true median once in {1 / (1 - weakest.coverage):.0f} (it covers with "
        f"{100 * weakest.coverage:.3g} %), so an order that rests on it may be chance."
    )


def _time(outcome: Outcome, row: Mapping[str, Outcome]) -> Cell:
    interval = outcome.seconds("total")
    if interval is None or not outcome.verified:
        symbol, words = VERDICTS[outcome.verdict]
        if interval is None:
            return Cell(text=words, symbol=symbol, kind="quiet", title=source(outcome))
        return Cell(
            text=seconds(interval), after=words, kind="void", title=source(outcome)
        )
    rivals = [o.seconds("total") for o in row.values() if o.verified]
    fastest = min((i for i in rivals if i is not None), key=lambda i: i.value)
    overlaps = interval.low <= fastest.high and interval.samples > 1
    kind = "best" if interval == fastest else "tied" if overlaps else ""
    return Cell(
        text=seconds(interval),
        symbol="≈" if kind == "tied" else "",
        kind=kind,
        title=source(outcome),
        value=interval.value,
    )


def iterations(evidence: Evidence) -> Section:
    """Show iterations, and whatever else the solvers count."""
    return Section(
        name="iterations",
        title="Iterations and counts",
        prose=(
            "Iterations of different methods cost differently; the counts say what "
            "they are made of. In parentheses: the answer was not verified.",
        ),
        tables=(
            _grid(evidence, "Iterations, as each solver counts them.", _iterations),
            *_counts(evidence),
        ),
    )


def _iterations(outcome: Outcome, _row: Mapping[str, Outcome]) -> Cell:
    its = outcome.iterations
    text = span(its)
    return Cell(
        text=text if outcome.verified or its is None else f"({text})",
        kind="" if outcome.verified else "quiet",
        title=source(outcome),
        value=its[0] if its else None,
    )


def _counts(evidence: Evidence) -> list[Table]:
    """Make one table per solver that counts something."""
    tables = []
    for solver in evidence.solvers:
        mine = [o for o in evidence.flat if o.solver == solver]
        names = list(dict.fromkeys(k for o in mine for k in o.first.counts))
        rows = [
            (*case_cells(o), *(_count(o, name) for name in names))
            for o in mine
            if o.first.counts
        ]
        if names:
            heads = tuple(clean(name.replace("_", " "), 40) for name in names)
            tables.append(
                Table(
                    caption=f"Counts of {clean(solver, 40)}, first repeat.",
                    columns=("case", "tol", *heads),
                    rows=tuple(rows),
                )
            )
    return tables


def _count(outcome: Outcome, name: str) -> Cell:
    n = outcome.first.counts.get(name)
    return Cell() if n is None else Cell(text=clean(str(n), 24), value=_number(n))


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def errors(evidence: Evidence) -> Section:
    """List the four residuals and, where there is one, the certified bound."""
    bounded = any(o.largest("energy_bound") is not None for o in evidence.flat)
    bound = (
        " Energy bound: a certified bound of the relative error in the energy norm, "
        "where the case has one."
    )
    measures = (*RESIDUALS, "energy_bound") if bounded else RESIDUALS
    heads = tuple(name.replace("_", " ") for name in measures)
    table = Table(
        caption="Residuals of every answer.",
        columns=("case", "solver", "tol", "verdict", *heads),
        rows=tuple(
            _residuals(o, measures) for o in evidence.flat if o.worst is not None
        ),
        text_columns=2,
    )
    return Section(
        name="errors",
        title="Errors",
        prose=(
            "The four scale-free residuals, each the worst over the repeats; coloured "
            "and bold where it exceeds what verification allows."
            f"{bound if bounded else ''}",
        ),
        tables=(table,),
    )


def _residuals(outcome: Outcome, measures: tuple[str, ...]) -> tuple[Cell, ...]:
    """Make one row of the table of errors."""
    allowed = min(VERIFIED_FACTOR * outcome.tol, 0.1)
    cells = []
    for name in measures:
        value = outcome.largest(name)
        over = value is not None and value > allowed and name in RESIDUALS
        cells.append(
            Cell(
                text=power(value),
                value=value,
                kind="over" if over else "",
                title=source(outcome),
            )
        )
    case, tol = case_cells(outcome)
    solver = Cell(text=clean(outcome.solver, 40))
    return (case, solver, tol, verdict_cell(outcome), *cells)


def _grid(
    evidence: Evidence,
    caption: str,
    show: Callable[[Outcome, Mapping[str, Outcome]], Cell],
) -> Table:
    """Make a table with a row per (case, tol) and a column per solver."""
    rows = []
    for row in evidence.outcomes.values():
        cells = [
            show(row[s], row) if s in row else Cell(text=ABSENT, title="not run")
            for s in evidence.solvers
        ]
        rows.append((*case_cells(row), *cells))
    return Table(
        caption=caption,
        columns=("case", "tol", *(clean(s, 40) for s in evidence.solvers)),
        rows=tuple(rows),
    )
