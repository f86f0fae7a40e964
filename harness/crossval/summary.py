"""Summary of a cross-validation: counts, rows per solver, lists of disagreements.

The summary is plain data, for the report, the terminal and ``--json``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

from mortarbench.harness.crossval.comparison import Answer, Problem
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


def as_data(validation: Validation, folder: str) -> dict[str, Any]:
    """Return the summary of a cross-validation, followed by all answers.

    folder : name of the result folder
    """
    answers = [a for p in validation.problems for a in p.answers]
    refuted = [a for a in answers if a.refuted]
    wrong = [
        *map(_disagreement, refuted),
        *map(_without_point, validation.false_claims),
    ]
    broken = [_remark(a, a.contradiction) for a in answers if a.contradiction]
    remarks = [_remark(a, text) for a in answers if not a.refuted for text in a.remarks]
    counts = {
        "problems": len(validation.problems),
        "cases": len({a.case for a in answers}),
        "solvers": len({a.solver for a in answers}),
        "answers": len(answers),
        "refuted": len(wrong),
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
        "solvers": [asdict(row) for row in _rows(validation)],
        "disagreements": wrong,
        "contradictions": broken,
        "remarks": remarks,
        "unanswered": list(map(asdict, validation.unanswered)),
        "not_validated": list(map(asdict, validation.not_validated)),
        "without_reference": without,
        "problems": list(map(_problem, validation.problems)),
    }
    return dict(finite(plain(data)))


def _rows(validation: Validation) -> list[Row]:
    """Summarise each solver at each tolerance.

    Rows are sorted by tolerance, loosest first, then by solver.
    """
    answers = [a for p in validation.problems for a in p.answers]
    keys = {(a.solver, a.tol) for a in answers}
    keys |= {
        (x.solver, x.tol) for x in (*validation.false_claims, *validation.unanswered)
    }
    ordered = sorted(keys, key=lambda key: (-key[1], key[0]))
    return [_row(validation, solver, tol) for solver, tol in ordered]


def _row(validation: Validation, solver: str, tol: float) -> Row:
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
        primal_dual=_worst(
            d.distance
            for p in validation.problems
            for d in p.primal_dual
            if (d.solver, d.tol) == (solver, tol)
        ),
    )


def _of(listed: Iterable[Listed], solver: str, tol: float) -> list[Listed]:
    return [x for x in listed if (x.solver, x.tol) == (solver, tol)]


def _worst(values: Iterable[float | None]) -> float | None:
    return max((v for v in values if v is not None), default=None)


def _headline(
    agreed: bool, counts: dict[str, int], wrong: Sequence[dict[str, Any]]
) -> str:
    """Return the result of the cross-validation as one or two sentences."""
    answers, solvers, cases = (
        _many(counts[f"{noun}s"], noun) for noun in ("answer", "solver", "case")
    )
    what = f"{answers} of {solvers} to {cases}"
    if proven := counts["proven_infeasible"]:
        what += f", {_many(proven, 'claim')} of infeasibility proven"
    if agreed:
        return f"No disagreement: {what}; every claim of success stands."
    parts = []
    if wrong:
        culprits = sorted({str(d["solver"]) for d in wrong})
        claims = _many(len(wrong), "claim")
        parts.append(f"{claims} refuted, of {some(culprits, 6)}")
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


def _remark(a: Answer, text: str) -> dict[str, Any]:
    return _about(a) | {"text": text, "error": a.error}


def _problem(p: Problem) -> dict[str, Any]:
    """Return a problem as plain data."""
    answers = [asdict(a) | {"error": a.error} for a in p.answers]
    data = {
        "name": p.name,
        "truth": p.truth,
        "doubt": p.doubt,
        "closed": p.closed,
        "note": p.note,
    }
    gaps = [d._asdict() for d in p.primal_dual]
    return data | {"answers": answers, "primal_dual": gaps}
