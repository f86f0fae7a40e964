"""Page that compares several result folders with the first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

from mortarbench.reports.compare.changes import Comparison, mean_ratio, side
from mortarbench.reports.compare.conclusions import change_word, headline, ratio_text
from mortarbench.reports.compare.conditions import hardware
from mortarbench.reports.compare.page import time_cell
from mortarbench.reports.data.cells import answer_columns
from mortarbench.reports.data.environment import by_environment, dateline
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.document.formatting import TIMED, clean
from mortarbench.reports.document.layout import Cell, Page, Part, Point, Section, Table
from mortarbench.reports.statistics.intervals import COVERAGE

Key = tuple[str, float, str, str]  #: case, tolerance, solver and machine


def overview(found: Sequence[Comparison]) -> Page:
    """Compose the page: changes since the first folder, then all times.

    found : comparisons of the first folder with each of the others
    """
    names = [clean(c.after.directory.resolve().name, 40) for c in found]
    first = clean(found[0].before.directory.resolve().name, 40)
    sections = (
        Section.of("summary", f"Changes since {first}", _summary(found, first, names)),
        Section.of("times", "Times", _times(found, first, names)),
    )
    return Page(
        title=f"{clean(found[-1].after.name)}: {', '.join(names)} against {first}",
        dateline=dateline(found[-1].after),
        sections=tuple(s for s in sections if s is not None),
        footer="For each folder, the changes since the first folder are on a separate "
        "page in report/against-….",
    )


def _summary(
    found: Sequence[Comparison], first: str, names: Sequence[str]
) -> Iterator[Part]:
    def mean(c: Comparison, solver: str) -> Cell:
        ratio = mean_ratio(c.of(solver))
        if ratio is None:
            return Cell(title="no cell has times in both folders")
        kind = "over" if side(ratio) > 0 else ""
        return Cell.number(ratio, ratio_text, after=change_word(ratio), kind=kind)

    named = [*zip(names, found, strict=True)]
    yield from (Point(f"{name}: {headline(c)}") for name, c in named)
    yield Table.of(
        f"Time relative to {first}: geometric mean over the cells that are verified in "
        f"both, with its {COVERAGE:.0%} bootstrap interval over cells.",
        dict.fromkeys(s for c in found for s in c.solvers),
        (("solver", Cell.name), *((name, partial(mean, c)) for name, c in named)),
    )


def _times(
    found: Sequence[Comparison], first: str, names: Sequence[str]
) -> Iterator[Part]:
    answers = [_by_machine(e) for e in (found[0].before, *(c.after for c in found))]
    known = {key: o for of in reversed(answers) for key, o in of.items()}
    machines = list(dict.fromkeys(key[-1] for of in answers for key in of))

    def machine(key: Key) -> Cell:
        number = machines.index(key[-1])
        return Cell.words(f"other machine {number}" if number else "first machine")

    def time(folder: int, key: Key) -> Cell:
        o = answers[folder].get(key)
        if o is None:
            return Cell(title="not measured")
        return time_cell(o, voided=not o.verified)

    yield "Struck out: the answer was not verified, so its time does not count."
    yield Table.of(
        f"Median times with their intervals. {TIMED}",
        dict.fromkeys(key for of in answers for key in of),
        (
            *answer_columns(known.__getitem__),
            *[("machine", machine)] * (len(machines) > 1),
            *((name, partial(time, k)) for k, name in enumerate((first, *names))),
        ),
        text_columns=2,
    )


def _by_machine(evidence: Evidence) -> dict[Key, Outcome]:
    """Return the outcomes by case, tolerance, solver and hardware.

    If several environments have the same hardware, the first of them is chosen.
    """
    machines = hardware(evidence)
    return {
        (o.case, o.tol, o.solver, machines[o.first.environment]): o
        for part in reversed(by_environment(evidence))
        for o in part.flat
    }
