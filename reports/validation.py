"""Summary of a cross-validation as plain data, its page and its table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any

from mortarbench.harness.crossval.comparison import Answer, Outcome
from mortarbench.harness.errors import some
from mortarbench.harness.record import finite
from mortarbench.harness.verify.verdicts import plain
from mortarbench.reports.document import (
    ABSENT,
    Document,
    Item,
    Section,
    Table,
    clean,
    number,
    plural,
    tolerance,
)
from mortarbench.reports.writing import write_document

SCHEMA = 2  #: version of the format of the summary
#: titles of the tables of answers, by outcome
OUTCOMES = {
    "refuted": "Refuted claims",
    "unanswered": "Measurements without a claim of success",
    "not validated": "Answers that could not be judged",
}
#: factor above the median error of all solvers from which on an error is pointed out
FAR = 100.0
RULES = (
    "Every case is built again, and residuals, errors and distances are computed from "
    "the stored points; the verdicts of the run are not used.",
    "The true solution of a problem is approximated by a reference solver that is not "
    "under test, whose error is bounded by the identity of Prager and Synge. Agreement "
    "of solvers is not used as evidence.",
    "Error: the larger of ‖u − u*‖ and ‖u_λ − u*‖ in the energy norm relative to ‖u*‖, "
    "plus the bound of the reference; u_λ is in equilibrium with the contact forces.",
    "A claim of success at tolerance t is refuted if a KKT residual exceeds 10t, if "
    "one of the two distances exceeds √(20t)‖u*‖, or if a contact force is tensile. A "
    "claim of infeasibility is refuted by the certified solution.",
)


def summary(answers: Sequence[Answer], folder: str) -> dict[str, Any]:
    """Return the summary of a cross-validation, followed by all answers.

    folder : name of the result folder

    Returns
    -------
    a dict with
    agreed : True if no claim is refuted
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
        "agreed": not counts["refuted"],
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


def _headline(counts: Mapping[str, int], answers: Sequence[Answer]) -> str:
    """Return the result of the cross-validation as one or two sentences."""
    what = _scope(counts)
    culprits = sorted({a.solver for a in answers if a.outcome is Outcome.REFUTED})
    if culprits:
        claims = plural(counts["refuted"], "refuted claim")
        return f"Disagreement: {claims} of {some(culprits, 6)}. {what}."
    return f"No disagreement: {what}; every claim of success stands."


def _scope(counts: Mapping[str, int]) -> str:
    answers, solvers, cases = (
        plural(counts[f"{noun}s"], noun) for noun in ("answer", "solver", "case")
    )
    return f"{answers} of {solvers} to {cases}"


def write_validation(directory: Path, data: Mapping[str, Any]) -> list[Path]:
    """Write report/validation.html and .md from the data of `validate`."""
    document = compose(data)
    return write_document(document, directory / "report", ("html", "md"), "validation")


def compose(data: Mapping[str, Any]) -> Document:
    """Compose the page, beginning with the verdict."""
    items: list[Item] = [clean(data["headline"], 600), *inaccurate(data)]
    sections = [
        Section(name="verdict", title="Verdict", items=(*items, solver_table(data)))
    ]
    for outcome, title in OUTCOMES.items():
        if (table := _answers(data, outcome)) is not None:
            name = outcome.replace(" ", "-")
            sections.append(Section(name=name, title=title, items=(table,)))
    sections.append(Section(name="rules", title="Rules of the verdict", items=RULES))
    return Document(
        title=f"Cross-validation of {clean(data['folder'])}",
        dateline=_scope(data["counts"]),
        sections=tuple(sections),
        solvers=tuple(dict.fromkeys(d["solver"] for d in data["solvers"])),
    )


def inaccurate(data: Mapping[str, Any]) -> list[str]:
    """Name the solvers whose median error is far above that of the others."""
    lines = []
    for tol in sorted({d["tol"] for d in data["solvers"]}):
        of = [d for d in data["solvers"] if d["tol"] == tol and d["error_median"]]
        errors = sorted(d["error_median"] for d in of)
        usual = errors[(len(errors) - 1) // 2] if errors else 0.0
        lines += [
            f"Far less accurate than the others at tol {tolerance(tol)}: "
            f"{clean(d['solver'], 40)}, median error {number(d['error_median'], 2)} "
            f"(the median solver: {number(usual, 2)})."
            for d in of
            if d["error_median"] > FAR * usual
        ]
    return lines


def solver_table(data: Mapping[str, Any]) -> Table:
    """Return the table of a cross-validation: one row per solver and tolerance."""
    return Table(
        name="validation",
        head=(
            "solver", "tol", "answers", "refuted", "unanswered", "error", "largest",
            "on", "primal to dual",
        ),
        rows=tuple(
            (
                clean(d["solver"], 40), tolerance(d["tol"]), str(d["answers"]),
                str(d["refuted"] or ""), str(d["unanswered"] or ""),
                number(d["error_median"], 2), number(d["error_worst"], 2),
                clean(d["worst_case"] or ABSENT, 48), number(d["primal_dual"], 2),
            )
            for d in data["solvers"]
        ),
        caption="Answers against the certified reference: error relative to the "
        "solution in the energy norm (median and largest), and largest distance "
        "between a solver's answers to primal and dual forms.",
    )  # fmt: skip


def _answers(data: Mapping[str, Any], outcome: str) -> Table | None:
    """Tabulate the answers with an outcome; equal texts of a solver are one row."""
    grouped: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for a in data["answers"]:
        if a["outcome"] == outcome:
            grouped.setdefault((a["solver"], a["text"]), []).append(a)
    if not grouped:
        return None
    return Table(
        name=outcome.replace(" ", "-"),
        head=("solver", "reason", "on", "answers", "largest error"),
        rows=tuple(
            (
                clean(solver, 40), clean(text, 300), clean(each[0]["case"], 60),
                str(len(each)),
                number(max((a["bound"] for a in each if a["bound"]), default=None), 2),
            )
            for (solver, text), each in grouped.items()
        ),
        caption="Answers with the same reason are one row, with the first case.",
        texts=3,
    )  # fmt: skip
