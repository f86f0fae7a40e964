"""Page of a cross-validation: verdict, disagreements, errors and rules."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mortarbench.harness import Verdict
from mortarbench.reports.document.formatting import (
    ABSENT,
    VERDICTS,
    clean,
    listing,
    plural,
    power,
)
from mortarbench.reports.document.layout import (
    Cell,
    Column,
    Page,
    Part,
    Picture,
    Section,
    Table,
)
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.render.html_page import html
from mortarbench.reports.render.markdown import markdown
from mortarbench.reports.render.writing import write_figures, write_text
from mortarbench.reports.validation.error_figure import error_figure

Data = Mapping[str, Any]
TEXT = Sentences(__name__)


def write_validation(directory: Path, data: Data) -> list[Path]:
    """Write report/validation.html and .md from the data of `validate`."""
    page, target = compose(data), directory / "report"
    _, drawings = write_figures(page, target)
    return [
        write_text(target / "validation.html", html(page, drawings)),
        write_text(target / "validation.md", markdown(page)),
    ]


def compose(data: Data) -> Page:
    """Compose the page, beginning with the verdict."""
    sections = (
        Section.of(*each)
        for each in (
            ("verdict", "Verdict", _verdict(data)),
            ("disagreements", "Disagreements", _disagreements(data)),
            ("problems", "Problems", _problems(data)),
            ("remarks", "Remarks", _remarks(data)),
            ("left-out", "Not compared", _left_out(data)),
            ("rules", "Rules of the verdict", TEXT.parts("rules")),
        )
    )
    answers, solvers, cases, asked = (
        plural(data["counts"][f"{noun}s"], noun)
        for noun in ("answer", "solver", "case", "problem")
    )
    return Page(
        title=f"Cross-validation of {clean(data['folder'])}",
        dateline=f"{answers} of {solvers} to {cases} of {asked}",
        sections=tuple(s for s in sections if s is not None),
        footer=TEXT("footer"),
    )


def _verdict(data: Data) -> Iterator[Part]:
    rows = data["solvers"]
    tols = {row["tol"] for row in rows}
    yield clean(data["headline"], 600)
    yield Table.of(
        TEXT("solvers", tols),
        rows,
        (
            _SOLVER,
            *[_TOL] * (len(tols) > 1),
            _column("answers"),
            (
                "refuted",
                lambda d: Cell.number(d["refuted"], kind="over" * bool(d["refuted"])),
            ),
            _column("unanswered"),
            _column("error, median", "error_median", power),
            _column("worst", "error_worst", power),
            ("worst on", _worst_case),
            _column("penetration / h", "penetration", power),
            _column("balance", "balance", power),
            _column("rows", "contradicted_rows"),
            _column("primal against dual", "primal_dual", power),
        ),
        notes=(TEXT("last_column"),),
    )
    answers = [a for p in data["problems"] for a in p["answers"]]
    tol = min((a["tol"] for a in answers), default=0.0)
    figure = error_figure(answers, tol)
    if figure is not None:  # claims without a point have no error
        caption = TEXT("errors", tol)
        yield Picture(name="validation-errors", caption=caption, figure=figure)


def _column(head: str, name: str = "", show: Callable[[Any], str] = str) -> Column:
    """Return a column of numbers from one field of the data."""
    return head, lambda d: Cell.number(d[name or head], show)


_SOLVER: Column = ("solver", lambda d: Cell.label(d["solver"]))
_TOL: Column = ("tol", lambda d: Cell.tolerance(d["tol"]))
_CASE: tuple[Column, ...] = (
    (
        "solver",
        lambda d: Cell.label(d["solver"], title=f"run {clean(d['run_id'], 40)}"),
    ),
    ("case", lambda d: Cell.name(d["case"])),
    _TOL,
)


def _worst_case(d: Data) -> Cell:
    case = d["worst_case"]
    return Cell.words(clean(case, 60) or ABSENT, title=clean(case, 2000))


def _disagreements(data: Data) -> Iterator[Part]:
    """Tabulate refuted claims, and certificates that the reference contradicts."""
    if wrong := data["disagreements"]:
        yield Table.of(
            "Refuted claims, with our verdict and the reason.",
            wrong,
            (
                *_CASE,
                ("claimed", lambda d: Cell.words(clean(d["claimed"], 20))),
                ("verdict", _judged),
                _column("error", show=power),
                ("reason", lambda d: Cell.words(clean(TEXT("why", d), 400))),
            ),
            text_columns=2,
        )
    if broken := data["contradictions"]:
        yield Table.of(
            "Certificates contradicted by the reference; every contradiction is an "
            "error of this program.",
            broken,
            (*_CASE, ("contradiction", lambda d: Cell.words(clean(d["text"], 240)))),
            text_columns=2,
        )


def _judged(d: Data) -> Cell:
    symbol, text = VERDICTS[Verdict(d["verdict"])]
    return Cell(text=text, symbol=symbol, kind=d["verdict"])


def _problems(data: Data) -> Iterator[Part]:
    """Tabulate the largest errors of the answers to each problem."""

    def largest(name: str) -> Callable[[Data], Cell]:
        def cell(p: Data) -> Cell:
            errors = [a["assessment"][name] for a in p["answers"] if a["assessment"]]
            return Cell.power(max((e for e in errors if e is not None), default=None))

        return cell

    def worst(p: Data) -> Cell:
        known = [a for a in p["answers"] if a["error"] is not None]
        a = max(known, key=lambda a: a["error"], default=None)
        return Cell.words(clean(f"{a['solver']} on {a['form']}", 80) if a else ABSENT)

    def doubt(p: Data) -> Cell:
        truth = "" if p["truth"] == "reference" else clean(p["truth"] or "none", 40)
        return Cell.power(p["doubt"], after=truth)

    yield Table.of(
        "Largest errors of the answers to each problem, over all solvers and forms.",
        data["problems"],
        (
            ("problem", lambda p: Cell.name(p["name"])),
            ("answers", lambda p: Cell.number(len(p["answers"]))),
            _column("closed rows", "closed"),
            ("error of the reference", doubt),
            ("largest error", largest("error")),
            ("of forces", largest("equilibrium_error")),
            ("of energies", largest("energy")),
            ("worst answer", worst),
        ),
        notes=(TEXT("errors_of_problems"),),
    )


def _remarks(data: Data) -> Iterator[Part]:
    """Tabulate anomalies of stored points whose claims stand."""
    if remarks := data["remarks"]:
        yield Table.of(
            "Anomalies of stored points whose claims stand.",
            remarks,
            (*_CASE, ("remark", lambda d: Cell.words(clean(d["text"], 200)))),
            text_columns=2,
        )


def _left_out(data: Data) -> Iterator[Part]:
    """Tabulate measurements without a claim of success, and answers not judged."""
    for name, caption in (
        ("unanswered", "Measurements that ended without a claim of success."),
        ("not_validated", "Stored answers that could not be judged."),
    ):
        grouped: dict[tuple[str, str], list[str]] = {}
        for d in sorted(data[name], key=lambda d: (d["solver"], d["text"], d["case"])):
            grouped.setdefault((d["solver"], d["text"]), []).append(d["case"])
        if grouped:
            yield Table.of(
                caption,
                grouped.items(),
                (
                    ("solver", lambda each: Cell.label(each[0][0])),
                    ("count", lambda each: Cell.number(len(each[1]))),
                    ("reason", lambda each: Cell.words(clean(each[0][1], 240))),
                    ("on", lambda each: _cases(list(dict.fromkeys(each[1])))),
                ),
            )
    yield from TEXT.parts("without_reference", data["without_reference"])


def _cases(names: Sequence[str]) -> Cell:
    return Cell.words(listing(names, 2), title=clean(", ".join(names), 2000))
