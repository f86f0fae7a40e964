"""Summary of a cross-validation: counts, rows per solver, lists of disagreements.

The summary is plain data, for the report, the terminal and ``--json``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

from mortarbench.harness.crossval.comparison import Answer, Pair, Problem
from mortarbench.harness.crossval.validation import Listed, Validation
from mortarbench.harness.errors import some
from mortarbench.harness.record import finite
from mortarbench.harness.verify.verdicts import plain

SCHEMA = 1  #: version of the format of the summary


@dataclass(frozen=True, kw_only=True)
class Row:
    """Summary of one solver at one tolerance; missing values are None."""

    solver: str
    tol: float
    answers: int  #: number of distinct stored points
    refuted: int  #: number of refuted claims
    unanswered: int  #: number of measurements in `Validation.unanswered`
    #: median of the bounds on the relative error in the energy norm
    error_median: float | None
    error_worst: float | None  #: largest bound on the relative error in the energy norm
    worst_case: str  #: case with the error `error_worst`
    penetration: float | None  #: largest penetration relative to the mesh size
    balance: float | None  #: largest relative resultant force or moment on a body
    #: number of contact rows, over all answers, whose state contradicts the reference
    contradicted_rows: int
    primal_dual: float | None  #: largest distance between primal and dual answers
    from_ours: float | None  #: largest distance from the answers of `ours`


def as_data(validation: Validation, folder: str, ours: str) -> dict[str, Any]:
    """Return the summary of a cross-validation, followed by all answers and pairs.

    folder : name of the result folder
    ours : label of the solver with which all other solvers are compared
    """
    answers = [a for p in validation.problems for a in p.answers]
    refuted = [a for a in answers if a.refuted]
    wrong = [
        *map(_disagreement, refuted),
        *map(_without_point, validation.false_claims),
    ]
    unresolved = [_apart(p, pair) for p in validation.problems for pair in p.unresolved]
    broken = [_remark(a, a.contradiction) for a in answers if a.contradiction]
    remarks = [_remark(a, text) for a in answers if not a.refuted for text in a.remarks]
    counts = {
        "problems": len(validation.problems),
        "cases": len({a.case for a in answers}),
        "solvers": len({a.solver for a in answers}),
        "answers": len(answers),
        "pairs": sum(len(p.pairs) for p in validation.problems),
        "refuted": len(wrong),
        "unresolved": len(unresolved),
        "contradictions": len(broken),
        "remarks": len(remarks),
        "unanswered": len(validation.unanswered),
        "declined": validation.declined,
        "proven_infeasible": validation.proven,
        "not_validated": len(validation.not_validated),
    }
    without = [
        {"problem": p.name, "truth": p.truth, "text": p.note}
        for p in validation.problems
        if p.truth != "reference"
    ]
    data = {
        "schema": SCHEMA,
        "folder": folder,
        "agreed": validation.agreed,
        "headline": _headline(validation.agreed, counts, wrong),
        "counts": counts,
        "solvers": [asdict(row) for row in _rows(validation, ours)],
        "disagreements": wrong,
        "unresolved": unresolved,
        "contradictions": broken,
        "remarks": remarks,
        "unanswered": list(map(asdict, validation.unanswered)),
        "not_validated": list(map(asdict, validation.not_validated)),
        "without_reference": without,
        "problems": list(map(_problem, validation.problems)),
    }
    return dict(finite(plain(data)))


def _rows(validation: Validation, ours: str) -> list[Row]:
    """Summarise each solver at each tolerance.

    Rows are sorted by tolerance, loosest first, then by solver, with `ours` first.
    """
    answers = [a for p in validation.problems for a in p.answers]
    keys = {(a.solver, a.tol) for a in answers}
    keys |= {
        (x.solver, x.tol) for x in (*validation.false_claims, *validation.unanswered)
    }
    ordered = sorted(keys, key=lambda key: (-key[1], key[0] != ours, key[0]))
    return [_row(validation, solver, tol, ours) for solver, tol in ordered]


def _row(validation: Validation, solver: str, tol: float, ours: str) -> Row:
    answers = [
        a
        for p in validation.problems
        for a in p.answers
        if (a.solver, a.tol) == (solver, tol)
    ]
    errors = [(e, a.case) for a in answers if (e := a.error) is not None]
    worst, worst_case = max(errors, default=(None, ""))
    false = _of(validation.false_claims, solver, tol)
    measured = [a.assessment for a in answers if a.assessment is not None]
    return Row(
        solver=solver,
        tol=tol,
        answers=len(answers),
        refuted=sum(bool(a.refuted) for a in answers) + len(false),
        unanswered=len(_of(validation.unanswered, solver, tol)),
        error_median=median(e for e, _ in errors) if errors else None,
        error_worst=worst,
        worst_case=worst_case,
        penetration=_worst(a.penetration for a in measured),
        balance=_worst(a.balance for a in measured),
        contradicted_rows=sum(len(a.rows) for a in measured),
        primal_dual=_worst(_between_forms(validation.problems, solver, tol)),
        from_ours=_worst(_between(validation.problems, solver, ours, tol)),
    )


def _of(listed: Iterable[Listed], solver: str, tol: float) -> list[Listed]:
    return [x for x in listed if (x.solver, x.tol) == (solver, tol)]


def _worst(values: Iterable[float | None]) -> float | None:
    return max((v for v in values if v is not None), default=None)


def _between_forms(
    problems: Sequence[Problem], solver: str, tol: float
) -> Iterable[float]:
    """Yield the distances between primal and dual answers of a solver."""
    for p in problems:
        for pair in p.pairs:
            a, b = p.answers[pair.a], p.answers[pair.b]
            if (a.solver, b.solver, a.tol) != (solver, solver, tol):
                continue
            if (a.form == "primal") != (b.form == "primal"):
                yield pair.distance


def _between(
    problems: Sequence[Problem], solver: str, other: str, tol: float
) -> Iterable[float]:
    """Yield the distances between the answers of two solvers, whatever their forms."""
    for p in problems:
        for pair in p.pairs:
            a, b = p.answers[pair.a], p.answers[pair.b]
            if a.tol == tol and sorted((a.solver, b.solver)) == sorted((solver, other)):
                yield pair.distance


def _headline(
    agreed: bool, counts: dict[str, int], wrong: Sequence[dict[str, Any]]
) -> str:
    """Return the result of the cross-validation as one or two sentences."""
    answers, solvers, cases, pairs = (
        _many(counts[f"{noun}s"], noun) for noun in ("answer", "solver", "case", "pair")
    )
    what = f"{answers} of {solvers} to {cases}, {pairs} compared"
    if proven := counts["proven_infeasible"]:
        what += f", {_many(proven, 'claim')} of infeasibility proven"
    if agreed:
        return f"No disagreement: {what}; every claim of success stands."
    parts = []
    if wrong:
        culprits = sorted({str(d["solver"]) for d in wrong})
        claims = _many(len(wrong), "claim")
        parts.append(f"{claims} refuted, of {some(culprits, 6)}")
    if counts["unresolved"]:
        parts.append(
            f"{_many(counts['unresolved'], 'pair')} too far apart, with neither answer "
            "refuted"
        )
    if counts["contradictions"]:
        broken = _many(counts["contradictions"], "certificate")
        parts.append(f"{broken} contradicted by the reference")
    return f"Disagreement: {'; '.join(parts)}. {what}."


def _many(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _disagreement(a: Answer) -> dict[str, Any]:
    """Return a refuted answer as plain data: claim, reasons, errors and rows."""
    assessment = a.assessment
    return _about(a) | {
        "claimed": a.claimed,
        "stored": a.stored.value,
        "verdict": a.verdict.value,
        "reasons": [*a.refuted, *a.remarks],
        "residual": max(a.residuals.values()),
        "error": a.error,
        "energy": None if assessment is None else assessment.energy,
        "rows": [] if assessment is None else list(assessment.rows),
        "pulls": [] if assessment is None else list(assessment.pulls),
    }


def _without_point(x: Listed) -> dict[str, Any]:
    infeasible = "no solution" in x.text
    return _about(x) | {
        "claimed": "infeasible" if infeasible else "solved",
        "stored": None,
        "verdict": "infeasible_claim" if infeasible else "wrong",
        "reasons": [x.text],
        "residual": None,
        "error": None,
        "energy": None,
        "rows": [],
        "pulls": [],
    }


def _about(x: Answer | Listed) -> dict[str, Any]:
    """Return the fields that identify a measurement."""
    return {"run_id": x.run_id, "solver": x.solver, "case": x.case, "tol": x.tol}


def _apart(p: Problem, pair: Pair) -> dict[str, Any]:
    a, b = (p.answers[i] for i in (pair.a, pair.b))
    return {
        "problem": p.name,
        "tol": a.tol,
        "between": [f"{x.solver} on {x.form}" for x in (a, b)],
        "run_ids": [a.run_id, b.run_id],
        "distance": max(pair.distance, pair.equilibrium or 0.0),
        "allowed": pair.allowed,
    }


def _remark(a: Answer, text: str) -> dict[str, Any]:
    return _about(a) | {"text": text, "error": a.error}


def _problem(p: Problem) -> dict[str, Any]:
    """Return a problem as plain data, in which pairs refer to answers by index."""
    answers = [asdict(a) | {"error": a.error} for a in p.answers]
    data = {
        "name": p.name,
        "truth": p.truth,
        "doubt": p.doubt,
        "closed": p.closed,
        "note": p.note,
    }
    return data | {"answers": answers, "pairs": [pair._asdict() for pair in p.pairs]}
