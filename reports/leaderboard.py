"""Leaderboard of a public set of QPs: tiers of solvers by class, and warm starts.

Solvers are compared at equal verified accuracy: all answers are judged at one accuracy,
and the time of a solver on a problem is that of the loosest tolerance whose answer is
verified at it. Solvers that cannot be told apart share a tier.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from mortarbench.reports.answer import Entry, Row, row_of, sentence, table
from mortarbench.reports.document import (
    ABSENT,
    Document,
    Item,
    Picture,
    Section,
    Table,
    clean,
    interval,
    number,
    plural,
    seconds,
    short,
    short_name,
)
from mortarbench.reports.export.records import plain, write_csv, write_parquet
from mortarbench.reports.figures.curves import answer_figure
from mortarbench.reports.figures.style import (
    curve,
    legend,
    legible,
    look,
    panels,
    styled,
)
from mortarbench.reports.intervals import Pooled, pooled
from mortarbench.reports.measurements import Measurements, in_order, read_measurements
from mortarbench.reports.sections import machine
from mortarbench.reports.sections.solvers import outcomes
from mortarbench.reports.writing import write_document

SHOWN_TIERS = 3  #: number of tiers with a column of their own
STEP = ["sequence", "step"]


def write_leaderboard(
    folder: Path, items: pd.DataFrame
) -> tuple[list[Path], list[str]]:
    """Write the leaderboard of a result folder to its subfolder ``report``.

    items : a row per class of a problem and per step of a sequence, with the columns
        `case` (name in the records), `name`, `group` (class, or kind of sequence),
        `sequence` (empty for single problems), `step`

    Returns
    -------
    files written, and the main sentences

    """
    run = read_measurements(folder)
    document = compose_leaderboard(run, items)
    formats = ("html", "md", "tex", "csv")
    target, frame = folder / "report", plain(run.df)
    files = [
        *write_document(document, target, formats, page="leaderboard"),
        write_csv(target / "tables" / "measurements.csv", frame),
        write_parquet(target / "records.parquet", frame),
    ]
    said = [
        item
        for section in document.sections[:2]
        for item in section.items
        if isinstance(item, str)
    ]
    return files, said


def compose_leaderboard(run: Measurements, items: pd.DataFrame) -> Document:
    """Compose the page: tiers, warm starts, ratios, then what went wrong."""
    steps = items[items.sequence != ""]
    found = [
        *class_rows(run, items[items.sequence == ""], "cold"),
        *class_rows(run, steps.assign(group="sequences"), "sequence"),
    ]
    sections = [
        ("leaderboard", "Leaderboard", (*_tiers(found),)),
        ("warm", "Warm starts", (*warm_starts(run, steps),)),
        ("ratios", "Ratios of times", (*_ratios(run, found),)),
        ("outcomes", "Outcomes", (*outcomes(run, found),)),
    ]
    digests = list(dict.fromkeys(run.df.environment))
    return Document(
        title=clean(run.name),
        dateline=" · ".join(
            [str(run.df.started.min())[:10], *(machine(run, d) for d in digests)]
        ),
        sections=tuple(
            Section(name=name, title=title, items=content)
            for name, title, content in sections
            if content
        ),
        solvers=tuple(map(short_name, run.solvers)),
    )


def loosest(answers: pd.DataFrame) -> pd.DataFrame:
    """Return the verified answers at the loosest tolerance of each solver and case."""
    good = answers[answers.verified].sort_values("tol", ascending=False, kind="stable")
    return good.drop_duplicates(["mode", "case", "solver"])


def class_rows(run: Measurements, items: pd.DataFrame, mode: str) -> Iterator[Row]:
    """Yield the comparison of the solvers on each class of problems.

    mode : ``cold`` or ``sequence``
    """
    answers = run.answers[(run.answers["mode"] == mode) & (run.answers.arm != "null")]
    for name, of in items.groupby("group", sort=False):
        every = answers[answers.case.isin(of.case)].assign(form=name)
        if len(every):
            accuracy = (run.suite and run.suite.accuracy) or float(every.tol.max())
            yield row_of(
                run, every, loosest(every), str(name), accuracy, by_error=False
            )


def _tiers(rows: list[Row]) -> Iterator[Item]:
    """State the fastest solver of each class, and tabulate the tiers."""
    yield from map(sentence, rows)
    lines = []
    for row in rows:
        of_tier: dict[int, list[Entry]] = {}
        for e in row.entries:
            of_tier.setdefault(e.tier, []).append(e)
        further = [e for tier in of_tier if tier > SHOWN_TIERS for e in of_tier[tier]]
        lines.append(
            (
                f"{row.form}\n{plural(row.entries[0].cases, 'problem')}",
                *(_names(of_tier.get(t + 1, [])) for t in range(SHOWN_TIERS)),
                _names(further),
                _names([e for e in of_tier.get(0, []) if e.met], solved=True),
            )
        )
    yield Table(
        name="tiers",
        head=("class", *(f"tier {t + 1}" for t in range(SHOWN_TIERS)), "further tiers",
              "solved fewer"),
        rows=tuple(lines),
        caption="Solvers from the fastest on, with their times relative to the fastest "
        "(geometric mean over the problems that both solved). A solver begins a new "
        "tier if the 95 % interval of its ratio to the first solver of the tier is "
        "above 1. Solvers that solved fewer than 90 % of the problems that any solver "
        "solved are not ranked.",
        texts=6,
    )  # fmt: skip


def _names(entries: list[Entry], *, solved: bool = False) -> str:
    return "\n".join(
        f"{short_name(e.solver)} {e.met}/{e.cases}"
        if solved or e.time is None
        else f"{short_name(e.solver)} {number(e.time.ratio.value, 2)}"
        for e in entries
    )


def _ratios(run: Measurements, rows: list[Row]) -> Iterator[Item]:
    yield table(rows, run.solvers)
    if any(len(row.ranked) > 1 for row in rows):
        yield Picture(
            name="ratios",
            caption="Time relative to the fastest solver of the class, with its 95 % "
            "interval.",
            draw=partial(answer_figure, rows, run.solvers),
        )


def warm_starts(run: Measurements, steps: pd.DataFrame) -> Iterator[Item]:
    """Compare sequences solved with the earlier answers with the steps solved alone.

    The cold and the warm solve of a sequence follow each other in each repeat. The time
    of a solver is that of the loosest tolerance at which all steps are verified, solved
    both ways.
    """
    of_step = ["group", "sequence", "step", "solver", "tol", "session", "repeat"]
    solves = run.df.merge(steps, on="case").pivot_table(
        ["total_seconds", "verified", "iterations"], of_step, "mode", "first"
    )
    if "sequence" not in solves.columns.get_level_values("mode"):
        return
    solves.columns = [f"{mode}_{value}" for value, mode in solves.columns]
    solves = solves.dropna(subset=["cold_total_seconds", "sequence_total_seconds"])
    solves = solves.reset_index()
    solves["both"] = (solves.cold_verified == 1) & (solves.sequence_verified == 1)
    whole = solves.groupby([c for c in of_step if c != "step"], sort=False).agg(
        steps=("step", "nunique"),
        verified=("both", "all"),
        cold=("cold_total_seconds", "sum"),
        warm=("sequence_total_seconds", "sum"),
    ).reset_index()  # fmt: skip
    wanted = steps.groupby("sequence").step.nunique()
    whole = whole[whole.verified & (whole.steps == whole.sequence.map(wanted))]
    loose = whole.groupby(["sequence", "solver"]).tol.transform("max")
    whole = whole[whole.tol == loose]
    whole = whole.assign(log=np.log(whole.warm / whole.cold))
    solves = solves.merge(whole[["sequence", "solver", "tol", "session", "repeat"]])
    yield from _warm_by_kind(run, whole, solves)
    yield Table(
        name="warm-sequences",
        head=("sequence", *map(short_name, run.solvers)),
        rows=tuple(
            (
                f"{clean(str(name), 60)}\n{group}, {plural(int(wanted[name]), 'step')}",
                *(_ratio(of[of.solver == s]) for s in run.solvers),
            )
            for (group, name), of in whole.groupby(["group", "sequence"], sort=False)
        ),
        caption="Whole sequences: time with warm starts relative to cold starts. "
        "Empty: not all steps verified. Single steps: tables/warm.csv.",
        data=whole,
    )
    yield Picture(
        name="warm-steps",
        caption="Time of each step with a warm start relative to the same step solved "
        "alone, on the first sequence of each kind.",
        draw=partial(_figure, solves, run.solvers),
    )


def _warm_by_kind(
    run: Measurements, whole: pd.DataFrame, solves: pd.DataFrame
) -> Iterator[Item]:
    """State where warm starts save or cost time, and tabulate them by kind."""
    found: dict[tuple[str, str], Pooled] = {
        (str(group), str(solver)): pooled(
            [logs.to_list() for _, logs in of.groupby("sequence").log],
            of.session.nunique(),
        )
        for (group, solver), of in whole.groupby(["group", "solver"])
    }
    saving = {key: p for key, p in found.items() if p.ratio.high < 1}
    costing = {key: p for key, p in found.items() if p.ratio.low > 1}
    yield f"Warm starts save time: {_listed(saving)}."
    yield f"Warm starts cost time: {_listed(costing)}."
    kinds = in_order(whole.group, ())
    lines = []
    for solver in run.solvers:
        cells = []
        for kind in kinds:
            of = whole[(whole.solver == solver) & (whole.group == kind)]
            won = of.groupby("sequence").log.median() < 0
            p = found.get((kind, solver))
            times = f"{seconds(of.cold.mean())} → {seconds(of.warm.mean())}"
            cells.append(
                f"{number(p.ratio.value, 2)} ×\n{interval(p.ratio)}\n{times}\n"
                f"faster on {won.sum()} of {len(won)}"
                if p
                else ABSENT
            )
        lines.append((short_name(solver), *cells))
    yield Table(
        name="warm",
        head=("solver", *kinds),
        rows=tuple(lines),
        caption="Time of sequences with warm starts relative to cold starts, each "
        "solver by its own means: geometric mean over the sequences of a kind, with "
        "its 95 % interval; below, the mean times of a sequence, cold → warm. In "
        "jumps, the load alternates between two steps that are far apart, so that the "
        "last answer misleads. Above 1, warm starts cost time.",
        data=solves,
    )


def _listed(found: Mapping[tuple[str, str], Pooled]) -> str:
    return "; ".join(
        f"{short_name(solver)} on {group} {short(p)}"
        for (group, solver), p in sorted(found.items(), key=lambda item: item[1].ratio)
    ) or "nowhere"  # fmt: skip


def _ratio(of: pd.DataFrame) -> str:
    return f"{np.exp(of.log.median()):.2f}" if len(of) else ""


def _figure(solves: pd.DataFrame, solvers: tuple[str, ...]) -> Figure:
    """Plot the ratio of warm to cold times by step, a panel for each kind."""
    kinds = list(solves.groupby("group", sort=False))
    with styled():
        figure, axes = panels(len(kinds), sharey=True)
        for one, (kind, of) in zip(axes, kinds, strict=True):
            of = of[of.sequence == of.sequence.iloc[0]]
            for solver in (s for s in solvers if s in set(of.solver)):
                mine = of[of.solver == solver].groupby("step")
                times = mine[["sequence_total_seconds", "cold_total_seconds"]].median()
                ratio = times.sequence_total_seconds / times.cold_total_seconds
                curve(one, ratio.index, ratio.to_numpy(), **look(solvers, solver))
            one.axhline(1, color="0.4", lw=0.6)
            one.set_title(legible(str(kind)))
            one.set_xlabel("step")
            one.set_yscale("log")
        axes[0].set_ylabel("warm time / cold time")
        legend(figure, axes)
    return figure
