"""Page of a cross-validation: verdict, disagreements, errors and rules."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mortarbench.reports.document.formatting import (
    ABSENT,
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
    Section,
    Table,
)
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.render.html_page import html
from mortarbench.reports.render.markdown import markdown
from mortarbench.reports.render.writing import write_text

Data = Mapping[str, Any]
TEXT = Sentences(__name__)


def write_validation(directory: Path, data: Data) -> list[Path]:
    """Write report/validation.html and .md from the data of `validate`."""
    page, target = compose(data), directory / "report"
    return [
        write_text(target / "validation.html", html(page)),
        write_text(target / "validation.md", markdown(page)),
    ]


def compose(data: Data) -> Page:
    """Compose the page, beginning with the verdict."""
    sections = (
        Section.of(*each)
        for each in (
            ("verdict", "Verdict", _verdict(data)),
            *(
                (outcome.replace(" ", "-"), title, _answers(data, outcome))
                for outcome, title in _TABLES.items()
            ),
            ("rules", "Rules of the verdict", TEXT.parts("rules")),
        )
    )
    answers, solvers, cases = (
        plural(data["counts"][f"{noun}s"], noun)
        for noun in ("answer", "solver", "case")
    )
    return Page(
        title=f"Cross-validation of {clean(data['folder'])}",
        dateline=f"{answers} of {solvers} to {cases}",
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
            _column("primal against dual", "primal_dual", power),
        ),
        notes=(TEXT("last_column"),),
    )


def _column(head: str, name: str = "", show: Callable[[Any], str] = str) -> Column:
    """Return a column of numbers from one field of the data."""
    return head, lambda d: Cell.number(d[name or head], show)


_SOLVER: Column = ("solver", lambda d: Cell.label(d["solver"]))
_TOL: Column = ("tol", lambda d: Cell.tolerance(d["tol"]))
#: titles of the tables of answers, by outcome
_TABLES = {
    "refuted": "Refuted claims",
    "contradicted": "Certificates that the reference contradicts",
    "unanswered": "Measurements without a claim of success",
    "not validated": "Answers that could not be judged",
}


def _worst_case(d: Data) -> Cell:
    case = d["worst_case"]
    return Cell.words(clean(case, 60) or ABSENT, title=clean(case, 2000))


def _answers(data: Data, outcome: str) -> Iterator[Part]:
    """Tabulate the answers with an outcome; equal texts of a solver are one row."""
    grouped: dict[tuple[str, str], list[Data]] = {}
    for a in data["answers"]:
        if a["outcome"] == outcome:
            grouped.setdefault((a["solver"], a["text"]), []).append(a)
    if grouped:
        yield Table.of(
            "Answers with the same reason are one row.",
            list(grouped.values()),
            (
                ("solver", lambda each: Cell.label(each[0]["solver"])),
                ("count", lambda each: Cell.number(len(each))),
                ("largest error", _largest_error),
                ("reason", lambda each: Cell.words(clean(each[0]["text"], 400))),
                ("on", lambda each: _cases([a["case"] for a in each])),
            ),
        )


def _largest_error(answers: Sequence[Data]) -> Cell:
    errors = [a["bound"] for a in answers if a["bound"] is not None]
    return Cell.power(max(errors, default=None))


def _cases(names: Sequence[str]) -> Cell:
    names = list(dict.fromkeys(names))
    return Cell.words(listing(names, 2), title=clean(", ".join(names), 2000))
