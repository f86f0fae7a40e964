"""Leaderboard of a public set of QPs: tiers of solvers by class, and warm starts.

All solvers have the same tolerance, at which their answers are judged. Solvers that
cannot be told apart share a tier.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from mortarbench.reports.answer import Row, row_of, sentence, table
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
from mortarbench.reports.export.records import plain, write_parquet
from mortarbench.reports.figures.curves import against
from mortarbench.reports.intervals import pooled
from mortarbench.reports.measurements import Measurements, in_order, read_measurements
from mortarbench.reports.sections import machine
from mortarbench.reports.sections.solvers import outcomes
from mortarbench.reports.writing import write_document

SHOWN_TIERS = 3  #: number of tiers with a column of their own


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
    document, target = compose_leaderboard(run, items), folder / "report"
    formats = ("html", "md", "tex", "csv")
    files = write_document(document, target, formats, page="leaderboard")
    files.append(write_parquet(target / "records.parquet", plain(run.df)))
    said = [item for part in document.sections[:2] for item in part.items]
    return files, [item for item in said if isinstance(item, str)]


def compose_leaderboard(run: Measurements, items: pd.DataFrame) -> Document:
    """Compose the page: tiers, warm starts, ratios, then what went wrong."""
    steps = items[items.sequence != ""]
    found = [
        *class_rows(run, items[items.sequence == ""], "cold"),
        *class_rows(run, steps.assign(group="sequences"), "sequence"),
    ]
    sections: list[tuple[str, str, Iterable[Item]]] = [
        ("leaderboard", "Leaderboard", [*map(sentence, found), tiers(found)]),
        ("warm", "Warm starts", warm_starts(run, steps)),
        ("ratios", "Ratios of times", [table(found, run.solvers)]),
        ("outcomes", "Outcomes", outcomes(run, found)),
    ]
    parts = [
        Section(name=n, title=t, items=tuple(content)) for n, t, content in sections
    ]
    machines = [machine(run, digest) for digest in dict.fromkeys(run.df.environment)]
    return Document(
        title=clean(run.name),
        dateline=" · ".join([str(run.df.started.min())[:10], *machines]),
        sections=tuple(part for part in parts if part.items),
        solvers=tuple(map(short_name, run.solvers)),
    )


def class_rows(run: Measurements, items: pd.DataFrame, mode: str) -> Iterator[Row]:
    """Yield the comparison of the solvers on each class of problems.

    mode : ``cold`` or ``sequence``
    """
    answers = run.answers[run.answers["mode"] == mode]
    for name, of in items.groupby("group", sort=False):
        every = answers[answers.case.isin(of.case)].assign(form=name)
        if len(every):
            good, tol = every[every.verified], float(every.tol.max())
            yield row_of(run, every, good, str(name), tol, by_error=False)


def tiers(rows: list[Row]) -> Table:
    """Tabulate the tiers of the solvers, a row per class."""
    lines = []
    for row in rows:
        # tiers, further tiers, and last those that have tier 0: they solved fewer
        cells: list[list[str]] = [[] for _ in range(SHOWN_TIERS + 2)]
        for e in row.entries:
            name, ranked = short_name(e.solver), e.tier and e.time
            text = number(ranked.ratio.value, 2) if ranked else f"{e.met}/{e.cases}"
            if e.met:
                cells[min(e.tier, SHOWN_TIERS + 1) - 1].append(f"{name} {text}")
        head = f"{row.form}\n{plural(row.entries[0].cases, 'problem')}"
        lines.append((head, *map("\n".join, cells)))
    numbered = (f"tier {k + 1}" for k in range(SHOWN_TIERS))
    return Table(
        name="tiers",
        head=("class", *numbered, "further tiers", "solved fewer"),
        rows=tuple(lines),
        caption="Solvers from the fastest on, with their times relative to the fastest "
        "(geometric mean over the problems that both solved). A solver begins a new "
        "tier if the 95 % interval of its ratio to the first solver of the tier is "
        "above 1. Solvers that solved fewer than 90 % of the problems that any solver "
        "solved are not ranked.",
        texts=6,
    )


def warm_starts(run: Measurements, steps: pd.DataFrame) -> Iterator[Item]:
    """Compare sequences solved with the earlier answers with the steps solved alone.

    The cold and the warm solve of a sequence follow each other in each repeat. Only
    sequences count all of whose steps were verified, solved both ways.
    """
    key = ["group", "sequence", "solver", "session", "repeat"]
    df = run.df[["case", "mode", *key[2:], "total_seconds", "verified"]]
    df = df.merge(steps, on="case")
    cold, warm = (df[df["mode"] == mode] for mode in ("cold", "sequence"))
    solves = cold.merge(warm, on=[*key, "step"], suffixes=("_cold", "_warm"))
    if solves.empty:
        return
    solves["ratio"] = solves.total_seconds_warm / solves.total_seconds_cold
    solves["both"] = solves.verified_cold & solves.verified_warm
    whole = solves.groupby(key, sort=False).agg(
        verified=("both", "sum"),
        cold=("total_seconds_cold", "sum"),
        warm=("total_seconds_warm", "sum"),
    ).reset_index()  # fmt: skip
    wanted = steps.groupby("sequence").step.nunique()
    whole = whole[whole.verified == whole.sequence.map(wanted)]
    whole = whole.assign(log=np.log(whole.warm / whole.cold))
    solves = solves.merge(whole[key])
    yield from _by_kind(run, whole, solves)
    ratios = np.exp(whole.pivot_table("log", key[:2], "solver", "median", sort=False))
    texts = ratios.reindex(columns=run.solvers).map("{:.2f}".format).replace("nan", "")
    yield Table(
        name="warm-sequences",
        head=("sequence", *map(short_name, run.solvers)),
        rows=tuple(
            (f"{clean(name, 60)}\n{group}, {plural(int(wanted[name]), 'step')}", *cells)
            for (group, name), *cells in texts.itertuples(name=None)
        ),
        caption="Whole sequences: time with warm starts relative to cold starts. "
        "Empty: not all steps verified. Single steps: tables/warm.csv.",
        data=whole,
    )
    first = solves.sequence == solves.groupby("group").sequence.transform("first")
    shown = solves[first].assign(family="")
    if figure := against(shown, run.solvers, "step", "ratio", by="group"):
        yield Picture(
            name="warm-steps",
            caption="Time of each step with a warm start relative to the same step "
            "solved alone, on the first sequence of each kind.",
            draw=lambda: figure,
        )


def _by_kind(
    run: Measurements, whole: pd.DataFrame, solves: pd.DataFrame
) -> Iterator[Item]:
    """State where warm starts save or cost time, and tabulate them by kind."""
    found = {
        key: pooled([*of.groupby("sequence").log.apply(list)], of.session.nunique())
        for key, of in whole.groupby(["group", "solver"])
    }
    listed = sorted(found.items(), key=lambda item: item[1].ratio)
    saving = [item for item in listed if item[1].ratio.high < 1]
    costing = [item for item in listed if item[1].ratio.low > 1]
    for verb, named in (("save", saving), ("cost", costing)):
        texts = [f"{short_name(solver)} on {group} {short(p)}"
                 for (group, solver), p in named]  # fmt: skip
        yield f"Warm starts {verb} time: {'; '.join(texts) or 'nowhere'}."
    kinds, lines = in_order(whole.group, ()), []
    for solver in run.solvers:
        cells = [short_name(solver)]
        for kind in kinds:
            of = whole[(whole.solver == solver) & (whole.group == kind)]
            if of.empty:
                cells.append(ABSENT)
                continue
            won, ratio = (
                of.groupby("sequence").log.median() < 0,
                found[kind, solver].ratio,
            )
            cells.append(
                f"{number(ratio.value, 2)} ×\n{interval(ratio)}\n"
                f"{seconds(of.cold.mean())} → {seconds(of.warm.mean())}\n"
                f"faster on {won.sum()} of {len(won)}"
            )
        lines.append(tuple(cells))
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
