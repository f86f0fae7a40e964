"""Summary of a cross-validation as plain data, for files, terminal and report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

from mortarbench.harness.crossval.comparison import Answer, Outcome
from mortarbench.harness.errors import some
from mortarbench.harness.record import finite
from mortarbench.harness.verify.verdicts import plain

SCHEMA = 2  #: version of the format of the summary
_WRONG = (Outcome.REFUTED, Outcome.CONTRADICTED)


@dataclass(frozen=True, kw_only=True)
class Row:
    """Summary of one solver at one tolerance; missing values are None.

    Errors are bounds on the relative error in the energy norm (`Answer.bound`).
    """

    solver: str
    tol: float
    answers: int  #: number of distinct stored points
    refuted: int  #: number of refuted claims
    unanswered: int  #: number of measurements without a claim of an answer
    error_median: float | None
    error_worst: float | None
    worst_case: str  #: case with the error `error_worst`
    primal_dual: float | None  #: largest distance between primal and dual answers


def as_data(answers: Sequence[Answer], folder: str) -> dict[str, Any]:
    """Return the summary of a cross-validation, followed by all answers.

    folder : name of the result folder
    """
    points = [a for a in answers if a.residual is not None]
    counts = {
        "answers": len(points),
        "solvers": len({a.solver for a in points}),
        "cases": len({a.case for a in points}),
        **{o.name.lower(): sum(a.outcome is o for a in answers) for o in Outcome},
    }
    agreed = not any(a.outcome in _WRONG for a in answers)
    keys = sorted({(-a.tol, a.solver) for a in answers})
    data = {
        "schema": SCHEMA,
        "folder": folder,
        "agreed": agreed,
        "headline": _headline(agreed, counts, answers),
        "counts": counts,
        "solvers": [asdict(_row(answers, solver, -tol)) for tol, solver in keys],
        "answers": [asdict(a) | {"bound": a.bound} for a in answers],
    }
    return dict(finite(plain(data)))


def _row(answers: Sequence[Answer], solver: str, tol: float) -> Row:
    mine = [a for a in answers if (a.solver, a.tol) == (solver, tol)]
    errors = [(bound, a.case) for a in mine if (bound := a.bound) is not None]
    distances = [a.primal_dual for a in mine if a.primal_dual is not None]
    worst, worst_case = max(errors, default=(None, ""))
    return Row(
        solver=solver,
        tol=tol,
        answers=sum(a.residual is not None for a in mine),
        refuted=sum(a.outcome is Outcome.REFUTED for a in mine),
        unanswered=sum(a.outcome is Outcome.UNANSWERED for a in mine),
        error_median=median(e for e, _ in errors) if errors else None,
        error_worst=worst,
        worst_case=worst_case,
        primal_dual=max(distances, default=None),
    )


def _headline(agreed: bool, counts: dict[str, int], answers: Sequence[Answer]) -> str:
    """Return the result of the cross-validation as one or two sentences."""
    what = ", ".join(
        [
            f"{_many(counts['answers'], 'answer')} of "
            f"{_many(counts['solvers'], 'solver')} to {_many(counts['cases'], 'case')}",
            *[f"{_many(counts['proven'], 'claim')} of infeasibility proven"]
            * bool(counts["proven"]),
        ]
    )
    if agreed:
        return f"No disagreement: {what}; every claim of success stands."
    parts = []
    if counts["refuted"]:
        culprits = sorted({a.solver for a in answers if a.outcome is Outcome.REFUTED})
        claims = _many(counts["refuted"], "claim")
        parts.append(f"{claims} refuted, of {some(culprits, 6)}")
    if counts["contradicted"]:
        broken = _many(counts["contradicted"], "certificate")
        parts.append(f"{broken} contradicted by the reference")
    return f"Disagreement: {'; '.join(parts)}. {what}."


def _many(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"
