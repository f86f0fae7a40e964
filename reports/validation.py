"""Page and table of a cross-validation."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

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

#: titles of the tables of answers, by outcome
OUTCOMES = {
    "refuted": "Refuted claims",
    "contradicted": "Certificates that the reference contradicts",
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
    counts = data["counts"]
    answers, solvers, cases = (
        plural(counts[f"{noun}s"], noun) for noun in ("answer", "solver", "case")
    )
    return Document(
        title=f"Cross-validation of {clean(data['folder'])}",
        dateline=f"{answers} of {solvers} to {cases}",
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
