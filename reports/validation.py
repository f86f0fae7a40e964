"""The page of a cross-validation: what agrees, what does not, and who is off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from harness import Verdict
from reports.layout import Cell, Page, Section, Table, name_cell
from reports.markdown import markdown
from reports.page import html
from reports.wording import ABSENT, VERDICTS, clean, plural, power, tolerance

Data = Mapping[str, Any]

_FOOTER = (
    "All answers and all pairs are in validation.json beside the journal, at full "
    "precision. Click a column's head to sort by it."
)

_RULES = (
    "Every case was built again, and residuals, errors and distances computed from the "
    "stored points; nothing that the run concluded was taken over.",
    "The truth u* of a problem comes from a reference solve that is none of the "
    "solvers. Its own error is bounded by the identity of Prager and Synge: with û "
    "admissible and u_λ the equilibrium under contact forces λ̂ ≥ 0, both are within "
    "√(2(J(û) − D(λ̂))) of u* in the energy norm. No majority decides.",
    "Error: the larger of ‖u − u*‖ and ‖u_λ − u*‖ over ‖u*‖ in the energy norm, plus "
    "the bound of the reference. The second is the distance ‖Bᵀ(λ − λ*)‖ of the "
    "contact forces in the dual norm; λ itself need not be unique.",
    "A claim of success at tolerance t is refuted if a KKT residual exceeds 10t; or if "
    "one of the two distances, less the bound of the reference, exceeds √(20t), which "
    "is what a gap of 10t allows; or if a multiplier pulls. A claim that there is no "
    "solution is refuted by the certified one.",
    "Two answers at one tolerance disagree without a culprit if they are farther apart "
    "than both claims allow, and neither is refuted.",
    "Rows: contact rows where truth and answer contradict each other. A row is closed "
    "where λᵢDᵢ > gapᵢ with its compliance Dᵢ; rows that are nearly neither are left "
    "out (force or gap below √(20t Dᵢ)‖u*‖).",
    "Penetration: largest max(Bu − c, 0) over the mesh size of the contact side. "
    "Balance: largest force or moment left on a body by load, supports and contact, "
    "relative to what acts on it.",
    "What stands out is no disagreement: the error is within the claim, but more than "
    "a hundred times the median of the other solvers on the same case, and above t.",
)


def write_validation(directory: Path, data: Data) -> list[Path]:
    """Write DIR/report/validation.html and .md from the data of `validate`."""
    page, target = compose(data), directory / "report"
    target.mkdir(parents=True, exist_ok=True)
    written = [target / "validation.html", target / "validation.md"]
    for path, text in zip(written, (html(page), markdown(page)), strict=True):
        path.write_text(text, encoding="utf-8", newline="\n")
    return written


def compose(data: Data) -> Page:
    """Put the page together, verdict first."""
    sections = (
        _verdict(data),
        _disagreements(data),
        _problems(data),
        _remarks(data),
        _left_out(data),
        Section(name="rules", title="How it is decided", points=_RULES),
    )
    answers, solvers, cases, problems, pairs = (
        plural(data["counts"][f"{noun}s"], noun)
        for noun in ("answer", "solver", "case", "problem", "pair")
    )
    return Page(
        title=f"Cross-validation of {clean(data['folder'])}",
        dateline=f"{answers} of {solvers} to {cases} of {problems}; {pairs} compared",
        sections=tuple(s for s in sections if s is not None),
        footer=_FOOTER,
    )


def _verdict(data: Data) -> Section:
    rows = data["solvers"]
    tols = {row["tol"] for row in rows}
    columns = (
        "solver", *(("tol",) if len(tols) > 1 else ()), "answers", "refuted",
        "unanswered", "error, median", "worst", "worst on", "penetration / h",
        "balance", "rows", "primal against dual", "against smalbe",
    )  # fmt: skip
    at = f", tol {tolerance(next(iter(tols)))}" if len(tols) == 1 else ""
    table = Table(
        caption=f"Every solver{at}: certified errors, relative, in the energy norm.",
        columns=columns,
        rows=tuple(_solver(row, several=len(tols) > 1) for row in rows),
        notes=(
            "The last two: largest distance between its answers to primal and dual "
            "forms, and from those of smalbe.",
        ),
    )
    return Section(
        name="verdict",
        title="Verdict",
        prose=(clean(data["headline"], 600),),
        tables=(table,),
    )


def _solver(row: Data, *, several: bool) -> tuple[Cell, ...]:
    tol = (Cell(text=tolerance(row["tol"]), value=row["tol"]),) if several else ()
    refuted = row["refuted"]
    return (
        Cell(text=clean(row["solver"], 40)),
        *tol,
        _count(row["answers"]),
        Cell(text=str(refuted), value=refuted, kind="over" if refuted else ""),
        _count(row["unanswered"]),
        _number(row["error_median"]),
        _number(row["error_worst"]),
        Cell(
            text=clean(row["worst_case"], 60) or ABSENT,
            kind="words",
            title=clean(row["worst_case"], 2000),
        ),
        _number(row["penetration"]),
        _number(row["balance"]),
        _count(row["contradicted_rows"]),
        _number(row["primal_dual"]),
        _number(row["from_ours"]),
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
            _listed("Certificates that the reference contradicts: our fault.", broken)
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
        Cell(text=clean(d["solver"], 40), title=f"run {clean(d['run_id'], 40)}"),
        name_cell(d["case"]),
        _tol(d),
        Cell(text=clean(d["claimed"], 20), kind="words"),
        Cell(text=words, symbol=symbol, kind=d["verdict"]),
        _number(d["error"]),
        Cell(text=clean(why, 400), kind="words"),
    )


def _apart(d: Data) -> tuple[Cell, ...]:
    return (
        name_cell(d["problem"]),
        Cell(text=clean(" and ".join(d["between"]), 120)),
        _tol(d),
        _number(d["distance"]),
        _number(d["allowed"]),
    )


def _problems(data: Data) -> Section:
    table = Table(
        caption="Every problem: all pairs of answers, of each solver and form.",
        columns=(
            "problem", "answers", "pairs", "closed rows", "error of the reference",
            "largest distance", "of forces", "of energies", "between",
        ),
        rows=tuple(map(_problem, data["problems"])),
        notes=(
            "Distances in the energy norm over ‖u*‖, energies over ½‖u*‖². A problem "
            "is a case without its form; without mechanics (file:), one QP, and the "
            "norm is that of P.",
        ),
    )  # fmt: skip
    return Section(name="problems", title="Problems", tables=(table,))


def _problem(p: Data) -> tuple[Cell, ...]:
    pairs, answers = p["pairs"], p["answers"]
    farthest = max(pairs, key=_distance, default=None)
    between = ABSENT
    if farthest is not None:
        between = " and ".join(_who(answers[farthest[k]]) for k in ("a", "b"))
    truth = "" if p["truth"] == "reference" else clean(p["truth"] or "none", 40)
    return (
        name_cell(p["name"]),
        _count(len(answers)),
        _count(len(pairs)),
        Cell() if p["closed"] is None else _count(p["closed"]),
        Cell(text=power(p["doubt"]), value=p["doubt"], after=truth),
        _number(_largest(pairs, "distance")),
        _number(_largest(pairs, "equilibrium")),
        _number(_largest(pairs, "energy")),
        Cell(text=clean(between, 80), kind="words"),
    )


def _distance(pair: Data) -> float:
    found = [pair[k] for k in ("distance", "equilibrium") if pair[k] is not None]
    return max(found, default=float("inf"))


def _who(a: Data) -> str:
    return f"{a['solver']} on {a['form']}"


def _remarks(data: Data) -> Section | None:
    """Say per solver how often it stands out, and where most."""
    grouped: dict[str, list[Data]] = {}
    for d in data["remarks"]:
        grouped.setdefault(d["solver"], []).append(d)
    if not grouped:
        return None
    rows = []
    for solver, mine in grouped.items():
        worst = max(mine, key=lambda d: d["error"] or 0.0)
        rows.append(
            (
                Cell(text=clean(solver, 40)),
                _count(len({d["run_id"] for d in mine})),
                _number(worst["error"]),
                Cell(text=clean(worst["case"]), kind="words"),
                Cell(text=clean(worst["text"], 200), kind="words"),
            )
        )
    table = Table(
        caption="Answers within what they claim that stand out from the others.",
        columns=("solver", "answers", "largest error", "on", "what"),
        rows=tuple(rows),
    )
    return Section(name="remarks", title="What stands out", tables=(table,))


def _left_out(data: Data) -> Section | None:
    """List what was asked and not answered, and what could not be judged."""
    named = (
        ("unanswered", "Measurements that ended without a claim."),
        ("not_validated", "Stored answers that could not be judged."),
    )
    tables = tuple(_listed(words, data[key]) for key, words in named if data[key])
    points = tuple(
        f"{clean(d['problem'])}: {clean(d['text'], 300)}; "
        + (f"{clean(d['truth'], 60)} stands for it" if d["truth"] else "residuals only")
        for d in data["without_reference"]
    )
    prose = ("These problems have no reference point:",) if points else ()
    if not tables and not points:
        return None
    return Section(
        name="left-out", title="Not compared", prose=prose, points=points,
        tables=tables,
    )  # fmt: skip


def _listed(caption: str, entries: Sequence[Data]) -> Table:
    return Table(
        caption=caption,
        columns=("solver", "case", "tol", "what"),
        rows=tuple(
            (
                Cell(
                    text=clean(d["solver"], 40), title=f"run {clean(d['run_id'], 40)}"
                ),
                name_cell(d["case"]),
                _tol(d),
                Cell(text=clean(d["text"], 240), kind="words"),
            )
            for d in entries
        ),
        text_columns=2,
    )


def _largest(pairs: Sequence[Data], name: str) -> float | None:
    return max((p[name] for p in pairs if p[name] is not None), default=None)


def _tol(d: Data) -> Cell:
    return Cell(text=tolerance(d["tol"]), value=d["tol"])


def _count(n: int) -> Cell:
    return Cell(text=str(n), value=n)


def _number(value: float | None) -> Cell:
    return Cell(text=power(value), value=value)
