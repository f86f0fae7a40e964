"""Claims, verdicts, iterations and residuals of every case and solver."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping

from mortarbench.harness import Verdict
from mortarbench.reports.data.cells import (
    case_cells,
    grid,
    legend,
    source,
    verdict_cell,
)
from mortarbench.reports.data.evidence import RESIDUALS, Evidence, Outcome
from mortarbench.reports.document.formatting import (
    ABSENT,
    clean,
    plain_value,
    power,
    span,
)
from mortarbench.reports.document.layout import Cell, Section, Table, name_cell, sources
from mortarbench.reports.statistics.profiles import share

#: (claimed to be solved, verified) and what that is called
KINDS = {
    (True, True): "claimed, verified",
    (True, False): "claimed, refuted",
    (False, True): "verified, not claimed",
    (False, False): "neither",
}


def claim_counts(evidence: Evidence) -> Section:
    """Count, for every solver, what it claimed and what was found."""
    count: dict[str, Counter[tuple[bool, bool]]] = defaultdict(Counter)
    for o in evidence.flat:
        if o.verdict is not Verdict.DECLINED:
            claimed = o.claims == ("solved",) or all(r.claims_answer for r in o.records)
            count[o.solver][claimed, o.verified] += 1
    return Section(
        name="tally",
        title="Claims and verdicts, counted",
        prose=(
            "Answers, one per case and tolerance, by what the solver said of them and "
            "what we found; of several repeats, all have to be claimed to be solved, "
            "and all to be verified; a proven claim of infeasibility counts as such an "
            "answer. Claims that hold: the share of such claims that "
            "were verified, with its 95 % interval (Clopper and Pearson).",
        ),
        tables=(
            Table(
                caption="Claims beside verdicts.",
                columns=("solver", *KINDS.values(), "claims that hold"),
                rows=tuple(_claim_row(s, count[s]) for s in evidence.solvers),
            ),
        ),
    )


def _claim_row(solver: str, count: Counter[tuple[bool, bool]]) -> tuple[Cell, ...]:
    cells = [
        Cell(
            text=str(count[kind]),
            value=count[kind],
            kind="over" if count[kind] and kind == (True, False) else "",
        )
        for kind in KINDS
    ]
    held, claimed = count[True, True], count[True, True] + count[True, False]
    if not claimed:
        return (name_cell(solver), *cells, Cell(text=ABSENT))
    value, low, high = (float(part) for part in share(held, claimed))
    text = f"{value:.2f} [{low:.2f}, {high:.2f}]"
    return (name_cell(solver), *cells, Cell(text=text, value=value))


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
            grid(evidence, "Verdicts and worst residuals.", _verdict),
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
    rows = tuple(_refutation(o) for o in refuted)
    return [
        Table(
            caption="Refuted claims: what the solver said, and the residual that says "
            "otherwise, with what verification allows.",
            notes=legend(rows),
            columns=("case", "solver", "tol", "verdict", "evidence", "its words"),
            rows=rows,
            text_columns=2,
        )
    ]


def _refutation(outcome: Outcome) -> tuple[Cell, ...]:
    """Make one row of the table of refuted claims."""
    values = {name: outcome.largest(name) for name in RESIDUALS}
    known = {name: v for name, v in values.items() if v is not None}
    name = max(known, key=lambda n: known[n], default=None)
    error = outcome.largest("optimum_error")
    if error is not None:
        evidence = (
            f"off the proven optimum by {power(error)} > {power(outcome.allowed)}"
        )
    elif name is None:
        evidence = "no point"
    else:
        evidence = f"{name} {power(known[name])} > {power(outcome.allowed)}"
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
    if outcome.verdict is Verdict.VERIFIED_INFEASIBLE:
        expected = "infeasible"
    claimed = [c for c in outcome.claims if c != expected]
    if claimed and outcome.verdict is not Verdict.DECLINED:
        after.append("claimed " + clean(", ".join(claimed).replace("_", " "), 40))
    cell = verdict_cell(outcome, ", ".join(after))
    message = clean(outcome.first.message, 240)
    return Cell(**{**vars(cell), "title": f"{message} · {cell.title}".lstrip(" ·")})


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
            grid(evidence, "Iterations, as each solver counts them.", _iterations),
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
                    solver=solver,
                )
            )
    return tables


def _count(outcome: Outcome, name: str) -> Cell:
    n = outcome.first.counts.get(name)
    if n is None:
        return Cell()
    return Cell(
        text=plain_value(n, 24), value=_number(n), title=sources([outcome.first])
    )


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
    answers = [o for o in evidence.flat if o.worst is not None]
    if not answers:
        none = "No solver handed over a point, so there are no residuals."
        return Section(name="errors", title="Errors", prose=(none,))
    rows = tuple(_residuals(o, measures) for o in answers)
    table = Table(
        caption="Residuals of every answer.",
        notes=legend(rows),
        columns=("case", "solver", "tol", "verdict", *heads),
        rows=rows,
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
    cells = []
    for name in measures:
        value = outcome.largest(name)
        over = value is not None and value > outcome.allowed and name in RESIDUALS
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
