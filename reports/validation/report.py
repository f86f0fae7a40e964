"""The page of a cross-validation: what agrees, what does not, and who is off."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mortarbench.harness import Verdict
from mortarbench.harness.crossval.discretisation import Discretisation
from mortarbench.reports.document.formatting import (
    ABSENT,
    VERDICTS,
    clean,
    plural,
    tolerance,
)
from mortarbench.reports.document.layout import (
    Cell,
    Page,
    Picture,
    Section,
    Table,
    name_cell,
)
from mortarbench.reports.document.mesh_errors import mesh_table
from mortarbench.reports.render.html_page import html
from mortarbench.reports.render.markdown import markdown
from mortarbench.reports.render.writing import write_figures, write_text
from mortarbench.reports.validation.compared import (
    Data,
    count_cell,
    left_out,
    listed,
    number_cell,
    problems,
    remarks,
    run,
    tol_cell,
)
from mortarbench.reports.validation.error_figure import error_figure

_FOOTER = (
    "All answers and all pairs are in validation.json beside the journal, at full "
    "precision. Click a column's head to sort by it."
)

_RULES = (
    "Every case was built again, and residuals, errors and distances computed from the "
    "stored points; nothing that the run concluded was taken over.",
    r"The truth \(u^*\) of a problem comes from a reference solve that is none of the "
    r"solvers. Its own error is bounded by the identity of Prager and Synge: with "
    r"\(\hat u\) admissible and \(u_\lambda\) the equilibrium under contact forces "
    r"\(\hat\lambda \ge 0\), both are within \(\sqrt{2(J(\hat u) - D(\hat\lambda))}\) "
    r"of \(u^*\) in the energy norm. No majority decides.",
    r"Error: the larger of \(\|u - u^*\|\) and \(\|u_\lambda - u^*\|\) over "
    r"\(\|u^*\|\) in the energy norm, plus the bound of the reference. The second is "
    r"the distance \(\|B^{\mathsf T}(\lambda - \lambda^*)\|\) of the contact forces in "
    r"the dual norm; \(\lambda\) itself need not be unique.",
    r"A claim of success at tolerance \(t\) is refuted if a KKT residual exceeds "
    r"\(10t\); or if one of the two distances, less the bound of the reference, is "
    r"above \(\sqrt{20t}\,\|u^*\|\), which is what a gap of \(10t\) allows; or if a "
    r"multiplier pulls. A claim that there "
    "is no solution is refuted by the certified one.",
    "Two answers at one tolerance disagree without a culprit if they are farther apart "
    "than both claims allow, and neither is refuted.",
    "Rows: contact rows where truth and answer contradict each other. A row is closed "
    r"where \(\lambda_i D_i > \mathrm{gap}_i\) with its compliance \(D_i\); rows that "
    r"are nearly neither are left out (force or gap below "
    r"\(\sqrt{20t D_i}\,\|u^*\|\)).",
    r"Penetration: largest \(\max(Bu - c, 0)\) over the mesh size of the contact side. "
    "Balance: largest force or moment left on a body by load, supports and contact, "
    "relative to what acts on it.",
    "What stands out is no disagreement: the error is within the claim, but more than "
    "a hundred times the median of the other solvers on the same case, and above t.",
)


def write_validation(
    directory: Path, data: Data, meshes: Sequence[Discretisation] = ()
) -> list[Path]:
    """Write DIR/report/validation.html and .md from the data of `validate`.

    meshes : what finer meshes told, where they were solved
    """
    page, target = compose(data, meshes), directory / "report"
    _, drawings = write_figures(page, target)
    return [
        write_text(target / "validation.html", html(page, drawings)),
        write_text(target / "validation.md", markdown(page)),
    ]


def compose(data: Data, meshes: Sequence[Discretisation] = ()) -> Page:
    """Put the page together, verdict first."""
    sections = (
        _verdict(data),
        _disagreements(data),
        problems(data),
        remarks(data),
        _discretisation(meshes),
        left_out(data),
        Section(name="rules", title="How it is decided", points=_RULES),
    )
    answers, solvers, cases, asked, pairs = (
        plural(data["counts"][f"{noun}s"], noun)
        for noun in ("answer", "solver", "case", "problem", "pair")
    )
    return Page(
        title=f"Cross-validation of {clean(data['folder'])}",
        dateline=f"{answers} of {solvers} to {cases} of {asked}; {pairs} compared",
        sections=tuple(s for s in sections if s is not None),
        footer=_FOOTER,
    )


def _verdict(data: Data) -> Section:
    rows = data["solvers"]
    tols = {row["tol"] for row in rows}
    ours = any(row["from_ours"] is not None for row in rows)
    columns = (
        "solver", *(("tol",) if len(tols) > 1 else ()), "answers", "refuted",
        "unanswered", "error, median", "worst", "worst on", "penetration / h",
        "balance", "rows", "primal against dual", *(("against smalbe",) * ours),
    )  # fmt: skip
    at = f", tol {tolerance(next(iter(tols)))}" if len(tols) == 1 else ""
    table = Table(
        caption=f"Every solver{at}: certified errors, relative, in the energy norm.",
        columns=columns,
        rows=tuple(_solver(row, several=len(tols) > 1, ours=ours) for row in rows),
        notes=(
            f"{'The last two' if ours else 'The last'}: largest distance between its "
            f"answers to primal and dual forms{', and from those of smalbe' * ours}.",
        ),
    )
    return Section(
        name="verdict",
        title="Verdict",
        prose=(clean(data["headline"], 600),),
        tables=(table,),
        pictures=_errors(data),
    )


def _errors(data: Data) -> tuple[Picture, ...]:
    """Draw the errors of all answers at the tightest tolerance."""
    answers = [a for p in data["problems"] for a in p["answers"]]
    tol = min((a["tol"] for a in answers), default=0.0)
    figure = error_figure(answers, tol)
    if figure is None:  # as where all that was judged are claims without a point
        return ()
    caption = (
        f"Certified error of every answer, over ‖u*‖, at tol {tolerance(tol)}. It is "
        "never below what is known of the reference. Beyond √(20t) no verified answer "
        "may lie."
    )
    return (Picture(name="validation-errors", caption=caption, figure=figure),)


def _solver(row: Data, *, several: bool, ours: bool) -> tuple[Cell, ...]:
    tol = (Cell(text=tolerance(row["tol"]), value=row["tol"]),) if several else ()
    refuted = row["refuted"]
    return (
        Cell(text=clean(row["solver"], 40)),
        *tol,
        count_cell(row["answers"]),
        Cell(text=str(refuted), value=refuted, kind="over" if refuted else ""),
        count_cell(row["unanswered"]),
        number_cell(row["error_median"]),
        number_cell(row["error_worst"]),
        Cell(
            text=clean(row["worst_case"], 60) or ABSENT,
            kind="words",
            title=clean(row["worst_case"], 2000),
        ),
        number_cell(row["penetration"]),
        number_cell(row["balance"]),
        count_cell(row["contradicted_rows"]),
        number_cell(row["primal_dual"]),
        *((number_cell(row["from_ours"]),) * ours),
    )


def _discretisation(meshes: Sequence[Discretisation]) -> Section | None:
    """List the errors of the meshes themselves, which certified errors add to."""
    if not meshes:
        return None
    return Section(
        name="discretisation",
        title="Errors of the meshes",
        prose=(
            "u* is the solution on a mesh; this is how far it is from that of the "
            "continuum. The report says what accuracy beyond it costs.",
        ),
        tables=(mesh_table(meshes),),
    )


def _disagreements(data: Data) -> Section | None:
    """List every refuted claim, and pairs apart without a culprit."""
    tables = []
    if wrong := data["disagreements"]:
        tables.append(
            Table(
                caption="Refuted claims: what the solver said, and what is true.",
                columns=("solver", "case", "tol", "claimed", "verdict", "error", "why"),
                rows=tuple(map(_wrong, wrong)),
                text_columns=2,
            )
        )
    if apart := data["unresolved"]:
        tables.append(
            Table(
                caption="Answers that contradict each other, neither refuted.",
                columns=("problem", "between", "tol", "distance", "allowed"),
                rows=tuple(map(_apart, apart)),
                text_columns=2,
            )
        )
    if broken := data["contradictions"]:
        tables.append(
            listed("Certificates that the reference contradicts: our fault.", broken)
        )
    if not tables:
        return None
    return Section(name="disagreements", title="Disagreements", tables=tuple(tables))


def _wrong(d: Data) -> tuple[Cell, ...]:
    symbol, words = VERDICTS[Verdict(d["verdict"])]
    why = "; ".join(d["reasons"])
    if d["rows"]:
        why += f"; contradicts contact at {plural(len(d['rows']), 'row')}"
    return (
        Cell(text=clean(d["solver"], 40), title=run(d)),
        name_cell(d["case"]),
        tol_cell(d),
        Cell(text=clean(d["claimed"], 20), kind="words"),
        Cell(text=words, symbol=symbol, kind=d["verdict"]),
        number_cell(d["error"]),
        Cell(text=clean(why, 400), kind="words"),
    )


def _apart(d: Data) -> tuple[Cell, ...]:
    return (
        name_cell(d["problem"]),
        Cell(text=clean(" and ".join(d["between"]), 120)),
        tol_cell(d),
        number_cell(d["distance"]),
        number_cell(d["allowed"]),
    )
