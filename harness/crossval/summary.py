"""Summary of a cross-validation as plain data, for files, terminal and report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from statistics import median
from typing import Any

from mortarbench.harness.crossval.comparison import Answer, Outcome
from mortarbench.harness.errors import some
from mortarbench.harness.record import finite
from mortarbench.harness.verify.verdicts import plain

SCHEMA = 2  #: version of the format of the summary


def as_data(answers: Sequence[Answer], folder: str) -> dict[str, Any]:
    """Return the summary of a cross-validation, followed by all answers.

    folder : name of the result folder

    Returns
    -------
    a dict with
    agreed : True if no claim is refuted and no certificate is contradicted
    headline : one or two sentences
    counts : numbers of distinct stored points (`answers`), of their solvers and cases,
        and of the answers with each outcome
    solvers : one dict for each solver and tolerance, see `_row`
    answers : all answers as dicts, with `Answer.bound`

    """
    points = [a for a in answers if a.residual is not None]
    counts = {
        "answers": len(points),
        "solvers": len({a.solver for a in points}),
        "cases": len({a.case for a in points}),
        **{o.name.lower(): sum(a.outcome is o for a in answers) for o in Outcome},
    }
    data = {
        "schema": SCHEMA,
        "folder": folder,
        "agreed": not counts["refuted"] + counts["contradicted"],
        "headline": _headline(counts, answers),
        "counts": counts,
        "solvers": [
            _row([a for a in answers if (-a.tol, a.solver) == key])
            for key in sorted({(-a.tol, a.solver) for a in answers})
        ],
        "answers": [asdict(a) | {"bound": a.bound} for a in answers],
    }
    return dict(finite(plain(data)))


def _row(answers: Sequence[Answer]) -> dict[str, Any]:
    """Summarise the answers of one solver at one tolerance; missing values are None.

    Errors are bounds on the relative error in the energy norm (`Answer.bound`).
    """
    errors = [(bound, a.case) for a in answers if (bound := a.bound) is not None]
    distances = [a.primal_dual for a in answers if a.primal_dual is not None]
    worst, worst_case = max(errors, default=(None, ""))
    return {
        "solver": answers[0].solver,
        "tol": answers[0].tol,
        "answers": sum(a.residual is not None for a in answers),
        "refuted": sum(a.outcome is Outcome.REFUTED for a in answers),
        "unanswered": sum(a.outcome is Outcome.UNANSWERED for a in answers),
        "error_median": median(e for e, _ in errors) if errors else None,
        "error_worst": worst,
        "worst_case": worst_case,
        "primal_dual": max(distances, default=None),
    }


def _headline(counts: dict[str, int], answers: Sequence[Answer]) -> str:
    """Return the result of the cross-validation as one or two sentences."""
    many = {
        noun: f"{n} {noun}{'s' * (n != 1)}"
        for noun, n in (
            *((noun, counts[f"{noun}s"]) for noun in ("answer", "solver", "case")),
            ("claim", counts["proven"]),
            ("refuted claim", counts["refuted"]),
            ("contradicted certificate", counts["contradicted"]),
        )
    }
    what = f"{many['answer']} of {many['solver']} to {many['case']}"
    if counts["proven"]:
        what += f", {many['claim']} of infeasibility proven"
    culprits = sorted({a.solver for a in answers if a.outcome is Outcome.REFUTED})
    wrong = [
        *[f"{many['refuted claim']} of {some(culprits, 6)}"] * bool(culprits),
        *[many["contradicted certificate"]] * bool(counts["contradicted"]),
    ]
    if wrong:
        return f"Disagreement: {' and '.join(wrong)}. {what}."
    return f"No disagreement: {what}; every claim of success stands."
