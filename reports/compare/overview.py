"""The page on several result folders: each one against the first."""

from __future__ import annotations

from collections.abc import Sequence

from mortarbench.reports.compare.changes import Comparison, Pair, mean_ratio, side
from mortarbench.reports.compare.conclusions import change_word, headline, ratio_text
from mortarbench.reports.data.cells import case_cells, source
from mortarbench.reports.data.environment import dateline
from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.document.formatting import (
    ABSENT,
    TIMED,
    VERDICTS,
    clean,
    seconds,
)
from mortarbench.reports.document.layout import Cell, Page, Section, Table, name_cell
from mortarbench.reports.statistics.intervals import COVERAGE


def overview(found: Sequence[Comparison]) -> Page:
    """Put the page together: what changed since the first folder, then all times.

    found : comparisons of one folder with each of several others
    """
    names = [clean(c.after.directory.resolve().name, 40) for c in found]
    first = clean(found[0].before.directory.resolve().name, 40)
    return Page(
        title=f"{clean(found[-1].after.name)}: {', '.join(names)} against {first}",
        dateline=dateline(found[-1].after),
        sections=(_summary(found, first, names), _times(found, first, names)),
        footer="Each folder has a page of its own on what changed since the first one, "
        "in report/against-….",
    )


def _summary(found: Sequence[Comparison], first: str, names: Sequence[str]) -> Section:
    solvers = dict.fromkeys(s for c in found for s in c.solvers)
    return Section(
        name="summary",
        title=f"What changed since {first}",
        points=tuple(
            f"{name}: {headline(c)}" for name, c in zip(names, found, strict=True)
        ),
        tables=(
            Table(
                caption=f"Time over that in {first}, geometric mean over the cells "
                f"that both hold verified, with its {COVERAGE:.0%} bootstrap interval "
                "over cells.",
                columns=("solver", *names),
                rows=tuple(
                    (name_cell(s), *(_mean(c.of(s)) for c in found)) for s in solvers
                ),
            ),
        ),
    )


def _mean(pairs: Sequence[Pair]) -> Cell:
    mean = mean_ratio(pairs)
    if mean is None:
        return Cell(text=ABSENT, title="no cell with times in both folders")
    return Cell(
        text=ratio_text(mean), after=change_word(mean), value=mean.value,
        kind="over" if side(mean) > 0 else "",
    )  # fmt: skip


def _times(found: Sequence[Comparison], first: str, names: Sequence[str]) -> Section:
    folders = [found[0].before, *(c.after for c in found)]
    cells = [
        {(o.case, o.tol, o.solver): o for o in evidence.flat} for evidence in folders
    ]
    keys = dict.fromkeys(key for of in cells for key in of)
    rows = [
        (*_names(next(of[key] for of in cells if key in of)),
         *(_time(of.get(key)) for of in cells))
        for key in keys
    ]  # fmt: skip
    caption = f"Median times with their intervals. {TIMED}"
    columns = ("case", "solver", "tol", first, *names)
    return Section(
        name="times",
        title="Times",
        prose=("Struck out: the answer was not verified, so its time is no result.",),
        tables=(
            Table(caption=caption, columns=columns, rows=tuple(rows), text_columns=2),
        ),
    )


def _names(o: Outcome) -> tuple[Cell, Cell, Cell]:
    case, tol = case_cells(o)
    return case, Cell(text=clean(o.solver, 40)), tol


def _time(o: Outcome | None) -> Cell:
    if o is None:
        return Cell(text=ABSENT, title="not measured")
    time = o.seconds("total")
    ended = "" if o.verified else VERDICTS[o.verdict][1]
    return Cell(
        text=seconds(time), after=ended, kind="" if o.verified else "void",
        title=source(o), value=time.value if time else None,
    )  # fmt: skip
