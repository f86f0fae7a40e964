"""What a cross-validation comes to: counts, one row per solver, lists of what is wrong.

The result is plain data, for a page, for a terminal and for machines alike.
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

SCHEMA = 1  #: of the data


@dataclass(frozen=True, kw_only=True)
class Row:
    """One solver at one tolerance; None where nothing was to be measured."""

    solver: str
    tol: float
    answers: int
    refuted: int
    unanswered: int
    error_median: float | None  #: certified, relative, energy norm
    error_worst: float | None
    worst_case: str  #: where that occurs
    penetration: float | None  #: worst, over the mesh size
    balance: float | None  #: worst force or moment left on a body
    contradicted_rows: int  #: closed in truth and open here, or the reverse
    primal_dual: float | None  #: worst distance of its answers to primal and dual forms
    from_ours: float | None  #: worst distance of its answers from ours


def as_data(found: Validation, folder: str, ours: str) -> dict[str, Any]:
    """Put a cross-validation together, summary first.

    ours : the solver that every other one is set against, where it took part
    """
    answers = [a for p in found.problems for a in p.answers]
    refuted = [a for a in answers if a.refuted]
    wrong = [*map(_disagreement, refuted), *map(_without_point, found.false_claims)]
    unresolved = [_apart(p, pair) for p in found.problems for pair in p.unresolved]
    broken = [_remark(a, a.contradiction) for a in answers if a.contradiction]
    outliers = [
        _remark(a, text) for a in answers if not a.refuted for text in a.remarks
    ]
    counts = {
        "problems": len(found.problems),
        "cases": len({a.case for a in answers}),
        "solvers": len({a.solver for a in answers}),
        "answers": len(answers),
        "pairs": sum(len(p.pairs) for p in found.problems),
        "refuted": len(wrong),
        "unresolved": len(unresolved),
        "contradictions": len(broken),
        "remarks": len(outliers),
        "unanswered": len(found.unanswered),
        "declined": found.declined,
        "proven_infeasible": found.proven,
        "not_validated": len(found.not_validated),
    }
    without = [
        {"problem": p.name, "truth": p.truth, "text": p.note}
        for p in found.problems
        if p.truth != "reference"
    ]
    data = {
        "schema": SCHEMA,
        "folder": folder,
        "agreed": found.agreed,
        "headline": _headline(found.agreed, counts, wrong),
        "counts": counts,
        "solvers": [asdict(row) for row in _rows(found, ours)],
        "disagreements": wrong,
        "unresolved": unresolved,
        "contradictions": broken,
        "remarks": outliers,
        "unanswered": list(map(asdict, found.unanswered)),
        "not_validated": list(map(asdict, found.not_validated)),
        "without_reference": without,
        "problems": list(map(_problem, found.problems)),
    }
    return dict(finite(plain(data)))


def _rows(found: Validation, ours: str) -> list[Row]:
    """Sum up every solver at every tolerance, the loosest first, ours before others."""
    answers = [a for p in found.problems for a in p.answers]
    keys = {(a.solver, a.tol) for a in answers}
    keys |= {(x.solver, x.tol) for x in (*found.false_claims, *found.unanswered)}
    ordered = sorted(keys, key=lambda key: (-key[1], key[0] != ours, key[0]))
    return [_row(found, solver, tol, ours) for solver, tol in ordered]


def _row(found: Validation, solver: str, tol: float, ours: str) -> Row:
    own = [
        a
        for p in found.problems
        for a in p.answers
        if (a.solver, a.tol) == (solver, tol)
    ]
    errors = [(e, a.case) for a in own if (e := a.error) is not None]
    worst, worst_case = max(errors, default=(None, ""))
    false = _of(found.false_claims, solver, tol)
    measured = [a.assessment for a in own if a.assessment is not None]
    return Row(
        solver=solver,
        tol=tol,
        answers=len(own),
        refuted=sum(bool(a.refuted) for a in own) + len(false),
        unanswered=len(_of(found.unanswered, solver, tol)),
        error_median=median(e for e, _ in errors) if errors else None,
        error_worst=worst,
        worst_case=worst_case,
        penetration=_worst(a.penetration for a in measured),
        balance=_worst(a.balance for a in measured),
        contradicted_rows=sum(len(a.rows) for a in measured),
        primal_dual=_worst(_between_forms(found.problems, solver, tol)),
        from_ours=_worst(_between(found.problems, solver, ours, tol)),
    )


def _of(listed: Iterable[Listed], solver: str, tol: float) -> list[Listed]:
    return [x for x in listed if (x.solver, x.tol) == (solver, tol)]


def _worst(values: Iterable[float | None]) -> float | None:
    return max((v for v in values if v is not None), default=None)


def _between_forms(
    problems: Sequence[Problem], solver: str, tol: float
) -> Iterable[float]:
    """Yield how far a solver's answers to the primal are from those to duals."""
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
    """Yield how far a solver's answers are from another's, of any form."""
    for p in problems:
        for pair in p.pairs:
            a, b = p.answers[pair.a], p.answers[pair.b]
            if a.tol == tol and sorted((a.solver, b.solver)) == sorted((solver, other)):
                yield pair.distance


def _headline(
    agreed: bool, counts: dict[str, int], wrong: Sequence[dict[str, Any]]
) -> str:
    """Say in one sentence what came of it."""
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
        parts.append(f"{_many(counts['unresolved'], 'pair')} apart without a culprit")
    if counts["contradictions"]:
        broken = _many(counts["contradictions"], "certificate")
        parts.append(f"{broken} contradicted by the reference")
    return f"Disagreement: {'; '.join(parts)}. {what}."


def _many(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _disagreement(a: Answer) -> dict[str, Any]:
    """Say what was claimed, what is true, and where."""
    found = a.assessment
    return _about(a) | {
        "claimed": a.claimed,
        "stored": a.stored.value,
        "verdict": a.verdict.value,
        "reasons": [*a.refuted, *a.remarks],
        "residual": max(a.residuals.values()),
        "error": a.error,
        "energy": None if found is None else found.energy,
        "rows": [] if found is None else list(found.rows),
        "pulls": [] if found is None else list(found.pulls),
    }


def _without_point(x: Listed) -> dict[str, Any]:
    infeasible = "no solution" in x.text
    return _about(x) | {
        "claimed": "infeasible" if infeasible else "solved",
        "stored": None,
        "verdict": "infeasible_claim" if infeasible else "wrong",
        "reasons": [x.text],
        "residual": None, "error": None, "energy": None, "rows": [], "pulls": [],
    }  # fmt: skip


def _about(x: Answer | Listed) -> dict[str, Any]:
    """Name a measurement."""
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
    """Lay out a problem with all answers, and pairs by the numbers of these."""
    answers = [asdict(a) | {"error": a.error} for a in p.answers]
    data = {
        "name": p.name, "truth": p.truth, "doubt": p.doubt, "closed": p.closed,
        "note": p.note,
    }  # fmt: skip
    return data | {"answers": answers, "pairs": [pair._asdict() for pair in p.pairs]}
