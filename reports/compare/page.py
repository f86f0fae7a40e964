"""The page on two result folders: what changed, and under which conditions."""

from __future__ import annotations

from collections.abc import Sequence

from mortarbench.reports.compare.changes import (
    Comparison,
    Mean,
    Pair,
    canary_ratio,
    mean_ratio,
    relative_ratio,
    side,
)
from mortarbench.reports.compare.conclusions import (
    cell_name,
    change_word,
    dates,
    named,
    ratio_text,
    sentences,
)
from mortarbench.reports.compare.conditions import (
    Difference,
    environments,
    options,
    settings,
)
from mortarbench.reports.compare.figure import ratios_figure
from mortarbench.reports.data.cells import case_cells, legend, source, verdict_cell
from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.document.formatting import (
    ABSENT,
    TIMED,
    VERDICTS,
    clean,
    plural,
    power,
    seconds,
    significant,
    span,
)
from mortarbench.reports.document.layout import (
    Cell,
    Page,
    Picture,
    Section,
    Table,
    name_cell,
)
from mortarbench.reports.statistics.intervals import COVERAGE


def compose(c: Comparison) -> Page:
    """Put the page together: conditions that differ first, then what changed."""
    names = [clean(e.directory.resolve().name, 40) for e in (c.before, c.after)]
    return Page(
        title=f"{clean(c.after.name)}: what changed from {names[0]} to {names[1]}",
        dateline=dates(c),
        sections=(
            _summary(c), _times(c), _verdicts(c), _iterations(c), _answers(c),
            _unpaired(c), conditions_that_differ(c),
        ),
        footer="Point at a number to see the run_id of its measurements: a cell has "
        "the same in both folders, in journal/ of each. Full precision: "
        "tables/changes.csv. Click a column's head to sort by it.",
    )  # fmt: skip


def _summary(c: Comparison) -> Section:
    rows = [_solver_row(c, solver) for solver in c.solvers]
    everything = mean_ratio(c.pairs)
    rows += [
        (Cell(text=name, kind="total"), *_mean_cells(mean, "total"), Cell(kind="total"))
        for name, mean in (("all", everything), ("canary", canary_ratio(c.pairs)))
        if mean is not None
    ]
    return Section(
        name="summary",
        title="Summary",
        prose=sentences(c),
        points=tuple(named(c)),
        tables=(
            Table(
                caption="Time after over time before, geometric mean over the cells "
                "that both folders hold verified, each cell once; in brackets the "
                f"{COVERAGE:.0%} bootstrap interval over cells. The canary is a fixed "
                "kernel: where it moved, or all solvers alike, the machine did. "
                "Relative: the same, divided by the mean of the other solvers on the "
                "cell, so that what slowed a whole run cancels.",
                columns=(
                    "solver",
                    "cells",
                    "ratio",
                    "change",
                    "relative to the others",
                ),
                rows=tuple(rows),
            ),
        ),
    )


def _solver_row(c: Comparison, solver: str) -> tuple[Cell, ...]:
    relative = relative_ratio(c, solver)
    return (
        name_cell(solver),
        *_mean_cells(mean_ratio(c.of(solver))),
        Cell(text=ratio_text(relative), value=relative.value) if relative else Cell(),
    )


def _mean_cells(mean: Mean | None, kind: str = "") -> tuple[Cell, ...]:
    if mean is None:
        return (Cell(text="0", value=0), Cell(), Cell())
    way = side(mean)
    return (
        Cell(text=str(mean.cells), value=mean.cells, kind=kind),
        Cell(text=ratio_text(mean), value=mean.value, kind=kind),
        Cell(text=change_word(mean), value=way, kind="over" if way > 0 else kind),
    )


def _times(c: Comparison) -> Section:
    shown = [p for p in c.pairs if all(o.seconds("total") for o in (p.before, p.after))]
    picture = Picture(
        name="ratios",
        caption="Time after over time before: a dot per cell, filled where its "
        f"{COVERAGE:.0%} interval excludes 1; bars: geometric mean of each solver with "
        "its bootstrap interval over cells.",
        figure=ratios_figure(c),
    )
    return Section(
        name="times",
        title="Times",
        prose=(
            "Medians of total time with their intervals, and the ratio after over "
            "before: the means of their logarithms, unpaired since the folders are "
            f"different sessions, with Welch's {COVERAGE:.0%} interval. A change is "
            "named only where that excludes 1. What differs between two runs as a "
            "whole (the state of the machine, the placing of a process) is not in "
            "these intervals: two runs of the same code tell how much that is.",
        ),
        tables=(
            Table(
                caption=f"Times before and after. {TIMED}",
                columns=("case", "solver", "tol", "before", "after", "ratio", "change"),
                rows=tuple(_time_row(p) for p in shown),
                text_columns=2,
            ),
        )
        if shown
        else (),
        pictures=(picture,) if any(p.log is not None for p in c.pairs) else (),
    )


def _time_row(p: Pair) -> tuple[Cell, ...]:
    times = [_time_cell(o, voided=p.log is None) for o in (p.before, p.after)]
    if p.ratio is None:
        why = (
            "other machine" if not p.same_machine
            else "not comparable" if not p.both_verified
            else "1 repeat"
        )  # fmt: skip
        return (*_names(p), *times, Cell(), Cell(text=why, kind="quiet"))
    return (
        *_names(p),
        *times,
        Cell(text=ratio_text(p.ratio), value=p.ratio.value, title=source(p.after)),
        Cell(
            text=change_word(p.ratio),
            value=p.change,
            kind={1: "over", 0: "quiet", -1: ""}[p.change],
        ),
    )


def _time_cell(outcome: Outcome, *, voided: bool) -> Cell:
    time = outcome.seconds("total")
    after = "" if outcome.verified else VERDICTS[outcome.verdict][1]
    return Cell(
        text=seconds(time), after=after, kind="void" if voided else "",
        title=source(outcome), value=time.value if time else None,
    )  # fmt: skip


def _verdicts(c: Comparison) -> Section:
    turned = [p for p in c.pairs if p.turn]
    rows = [
        (
            *_names(p),
            verdict_cell(p.before, power(p.before.worst)),
            verdict_cell(p.after, power(p.after.worst)),
            Cell(text="worse" if p.turn > 0 else "better", value=p.turn,
                 kind="over" if p.turn > 0 else ""),
        )
        for p in sorted(turned, key=lambda p: -p.turn)
    ]  # fmt: skip
    columns = ("case", "solver", "tol", "before", "after", "change")
    caption = "Verdicts that changed, with the worst residual; the worst repeat counts."
    return _listed("verdicts", "Verdicts", caption, columns, rows)


def _iterations(c: Comparison) -> Section:
    rows = [
        (
            *_names(p),
            *(Cell(text=span(o.iterations), value=(o.iterations or (0,))[0],
                   title=source(o)) for o in (p.before, p.after)),
        )
        for p in c.pairs
        if p.other_iterations
    ]  # fmt: skip
    columns = ("case", "solver", "tol", "before", "after")
    caption = "Iterations of cells where no repeat took as many as one before."
    return _listed("iterations", "Iterations", caption, columns, rows)


def _answers(c: Comparison) -> Section:
    rows = [
        (
            *_names(p),
            *(Cell(text=significant(v, 12), value=v) for v in p.answers[:2]),
            Cell(text=power(p.answers[2]), value=p.answers[2]),
            Cell(text=power(p.may_differ), value=p.may_differ),
        )
        for p in c.pairs
        if p.other_answer and p.answers is not None
    ]
    columns = ("case", "solver", "tol", "before", "after", "difference", "allowed")
    caption = (
        "Energies (objectives, where there are none) of verified answers that are "
        "further apart than the allowed gaps explain; relative to the larger."
    )
    return _listed("answers", "Answers", caption, columns, rows)


def _unpaired(c: Comparison) -> Section:
    rows = [
        (case, Cell(text=clean(o.solver, 40)), tol, Cell(text=where, kind="words"),
         verdict_cell(o))
        for where, outcomes in (("before", c.only_before), ("after", c.only_after))
        for o in outcomes
        for case, tol in [case_cells(o)]
    ]  # fmt: skip
    columns = ("case", "solver", "tol", "only", "verdict")
    return _listed("unpaired", "In one folder only", "Cells without a partner.",
                   columns, rows)  # fmt: skip


def _listed(
    name: str,
    title: str,
    caption: str,
    columns: tuple[str, ...],
    rows: Sequence[tuple[Cell, ...]],
) -> Section:
    """Make a section of one table, or of the word that there is nothing to list."""
    if not rows:
        return Section(name=name, title=title, prose=("None.",))
    table = Table(
        caption=caption,
        notes=legend(rows),
        columns=columns,
        rows=tuple(rows),
        text_columns=2,
    )
    return Section(name=name, title=title, tables=(table,))


def _names(p: Pair) -> tuple[Cell, Cell, Cell]:
    case, tol = case_cells(p.after)
    return case, Cell(text=clean(p.after.solver, 40)), tol


def conditions_that_differ(c: Comparison) -> Section:
    """List environments, settings and options that differ, and QPs that changed."""
    found = (
        ("Environments, as recorded.", environments(c.before, c.after)),
        ("Settings of the suites.", settings(c.before, c.after)),
        ("Options of solvers with one label.", options(c.before, c.after)),
    )
    tables = [_differing(caption, pairs) for caption, pairs in found if pairs]
    other = [p for p in c.pairs if not p.same_qp]
    prose = [] if tables else ["No condition differs."]
    if other:
        prose.append(
            f"{plural(len(other), 'cell')} had another QP after than before, bit for "
            "bit: the family, its parameters' meaning or the BLAS changed. The "
            f"first: {cell_name(other[0])}. Where sizes differ, nothing is compared."
        )
    return Section(
        name="conditions",
        title="Conditions that differ",
        prose=tuple(prose),
        tables=tuple(tables),
    )


def _differing(caption: str, pairs: Sequence[Difference]) -> Table:
    return Table(
        caption=caption,
        columns=("key", "before", "after"),
        rows=tuple(
            (Cell(text=clean(k)), *(Cell(text=_plain(v), kind="words") for v in values))
            for k, *values in pairs
        ),
    )


def _plain(value: object) -> str:
    return ABSENT if value is None else clean(str(value), 120)
