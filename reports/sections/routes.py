"""Sections that compare ways to one answer: forms, sequences, numbers of ranks."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
import pandas as pd

from mortarbench.reports.answer import Row, fastest
from mortarbench.reports.document import (
    Item,
    Picture,
    Table,
    clean,
    number,
    seconds,
    short,
    short_name,
    tolerance,
)
from mortarbench.reports.figures import curves
from mortarbench.reports.intervals import Pooled, pooled
from mortarbench.reports.measurements import Measurements, in_order, series_of
from mortarbench.reports.sections.solvers import tightest

MULTIGRID = "ipm-amg"  #: solver whose use of the primal form is a route of its own
#: keys that choose a decomposition, which do not change the mesh
DECOMPOSITION = ("feti", "glue", "parts")
MOST_WAYS = 12  #: largest number of rows in the table of ways
LEAST_SIZES = 3  #: smallest number of sizes of a map of routes
LEAST_ROUTES = 3  #: smallest number of routes of a map; `_ways` compares two forms


def mesh(run: Measurements, rows: list[Row]) -> Iterator[Item]:
    """Compare combinations of form and solver with the dualisation charged."""
    del rows
    answers = tightest(run.answers)
    answers = answers[answers.verified & (answers.total_seconds > 0)]
    dual = answers.form.str.startswith("dual")
    if dual.any() and not dual.all():
        yield from _ways(answers, in_order(answers.form, ("primal", "dual")))
    yield from _map(answers)


def _ways(answers: pd.DataFrame, forms: list[str]) -> Iterator[Item]:
    charged = answers.total_seconds + answers.dualise_seconds.fillna(0)
    way = answers.solver + " on " + answers.form
    logs = np.log(
        answers.assign(charged=charged, way=way)
        .pivot_table("charged", "problem", "way", "first")
        .replace(0, np.nan)
    )
    first = fastest(logs)
    found = []
    for name in logs:
        d = (logs[name] - logs[first]).dropna()
        if len(d):
            found.append((pooled([[v] for v in d]), str(name), int(logs[name].count())))
    found.sort(key=lambda each: (each[1] != first, each[0].ratio.value))
    problems = len(logs)
    best: dict[str, tuple[Pooled, str, int]] = {}
    for form in forms:
        of_form = [each for each in found if each[1].endswith(f" on {form}")]
        best |= {form: of_form[0]} if of_form else {}
    tied = [f"{name} {short(t)}" for t, name, _ in found[1:3] if t.ratio.low <= 1]
    lead = f"cannot tell {first} from {', '.join(tied)}" if tied else f"{first} fastest"
    others = [
        f"best on {form}: {clean(name.removesuffix(f' on {form}'), 40)} {short(time)}"
        for form, (time, name, _) in best.items()
        if name != first
    ]
    tol = tolerance(float(answers.tol.min()))
    yield "; ".join([f"{clean(lead, 200)}, dualisation charged", *others]) + "."
    yield Table(
        name="ways",
        head=("solver and form", "time relative to the fastest", "problems"),
        rows=tuple(
            (
                clean(name, 60),
                "1 (fastest)" if name == first else short(time),
                f"{n}/{problems}",
            )
            for time, name, n in found[:MOST_WAYS]
        ),
        caption="Time of dualisation (dual forms), preparation and solve at tolerance "
        f"{tol}: geometric mean over the problems, with Student's 95 % interval. "
        "Assembly, the same for all forms, is not included.",
    )


def route_of(answers: pd.DataFrame) -> pd.Series:
    """Return the route of each answer: form, decomposition and number of ranks."""
    divided = [p.get("feti") or p.get("parts") or 0 for p in answers.params]
    base = answers.solver.str.split(" ranks=").str[0]
    names = [
        (f"TFETI, H/h = {k}" if k else f"{form}, multigrid" if amg else form)
        + (f", {n} ranks" if n > 1 else "")
        for form, k, amg, n in zip(
            answers.form, divided, base == MULTIGRID, answers.ranks, strict=True
        )
    ]
    return pd.Series(names, index=answers.index)


def _map(answers: pd.DataFrame) -> Iterator[Item]:
    """Plot the times from the mesh of the routes, on meshes of several sizes."""
    fresh = answers[(answers.mesh_seconds > 0) & (answers.n > 0)]
    if fresh.empty:
        return
    params = [
        {k: v for k, v in p.items() if k not in DECOMPOSITION} for p in fresh.params
    ]
    fresh = fresh.assign(params=params, route=route_of(fresh))
    fresh = fresh.assign(series=series_of(fresh))
    fresh = fresh.assign(memory=fresh.peak_mib).sort_values("mesh_seconds")
    best = fresh.drop_duplicates(["series", "route", "n"])
    kept = best.groupby("series").n.nunique()
    best = best[best.series.isin(kept.index[kept >= LEAST_SIZES])]
    if best.route.nunique() < LEAST_ROUTES:
        return
    yield Table(
        name="routes",
        head=("route", "largest n", "solver", "time", "memory"),
        rows=tuple(
            (
                short_name(str(route)), number(top.n, 3), short_name(top.solver),
                seconds(top.mesh_seconds), f"{top.memory:.0f} MiB",
            )
            for route, of in best.groupby("route", sort=False)
            for top in [of.loc[of.n.idxmax()]]
        ),
        caption="Largest size that each route reached, with its fastest solver: time "
        "from the mesh to the recovered answer, and peak memory of the solve.",
    )  # fmt: skip
    yield from _pays(best)
    for y, words in (("mesh_seconds", "Time"), ("memory", "Peak memory")):
        yield Picture(
            name=f"routes-{y.partition('_')[0]}",
            caption=f"{words} from the mesh (build, prepare, solve, recovery) of the "
            "fastest verified solver of each route; curves end at the largest size "
            "that a route reached.",
            draw=partial(curves.routes, best, y),
        )


def _pays(best: pd.DataFrame) -> Iterator[str]:
    """State from which size on each dual route is faster than the primal one."""
    for series, of in best.groupby("series", sort=False):
        times = of.pivot_table("mesh_seconds", "n", "route", "first")
        primal = [r for r in times if str(r).startswith("primal")]
        lines = []
        for route in (r for r in times if r not in primal):
            rivals = times[primal].min(axis=1)
            both = times[times[route].notna() & rivals.notna()]
            faster = both[route] < rivals[both.index]
            slower = both.index[~faster]
            beyond = both.index[both.index > (slower.max() if len(slower) else 0)]
            if len(beyond):
                lines.append(
                    f"{clean(str(route), 60)} from n = {number(float(beyond[0]))} on"
                )
        if primal and lines:
            text = f"faster than the primal routes: {'; '.join(lines)}"
            yield f"{clean(str(series))}: {text}."


def sequences(run: Measurements, rows: list[Row]) -> Iterator[Item]:
    """Compare the steps of sequences, solved with earlier results, with cold solves."""
    del rows
    answers = run.answers[run.answers.verified & (run.answers.total_seconds > 0)]
    warm = answers[answers["mode"] != "cold"]
    if warm.empty:
        return
    cold = answers[answers["mode"] == "cold"]
    lines = []
    for (form, solver), of in warm.groupby(["form", "solver"], sort=False):
        both = of.merge(cold, on=["case", "tol", "solver"], suffixes=("", "_cold"))
        logs = np.log(both.total_seconds / both.total_seconds_cold)
        lines.append(
            (
                clean(str(form), 24),
                short_name(str(solver)),
                str(of.case.nunique()),
                seconds(float(of.total_seconds.sum())),
                seconds(float(both.total_seconds_cold.sum())) if len(both) else "",
                short(pooled([[v] for v in logs])) if len(both) else "",
                number(float((both.iterations / both.iterations_cold).mean()))
                if len(both)
                else "",
            )
        )
    yield Table(
        name="sequences",
        head=("form", "solver", "steps", "warm", "cold", "warm/cold", "iterations"),
        rows=tuple(lines),
        caption="Steps that may reuse results of earlier steps (warm), against the "
        "same cases solved alone (cold): total times; geometric mean of the ratio "
        "of the times with Student's 95 % interval; mean ratio of the iterations.",
        texts=2,
    )  # fmt: skip


def ranks(run: Measurements, rows: list[Row]) -> Iterator[Item]:
    """Compare solves on several ranks with one rank."""
    del rows
    df = run.df[run.df.verified & (run.df.solve_seconds > 0)]
    df = df.assign(base=df.solver.str.split(" ranks=").str[0])
    key = ["case", "tol", "base"]
    df = df[df.groupby(key).ranks.transform("nunique") > 1]
    if df.empty:
        return
    lines = []
    for (case, tol, base), of in df.groupby(key, sort=False):
        one = of[of.ranks == of.ranks.min()].set_index(["session", "repeat"])
        for n, several in of[of.ranks > of.ranks.min()].groupby("ranks"):
            there = several.set_index(["session", "repeat"])
            d = (np.log(one.solve_seconds) - np.log(there.solve_seconds)).dropna()
            lines.append(
                (
                    clean(str(case)),
                    short_name(str(base)),
                    tolerance(float(tol)),
                    str(n),
                    seconds(float(one.solve_seconds.median())),
                    seconds(float(there.solve_seconds.median())),
                    short(pooled([d])) if len(d) else "",
                    f"{there.peak_mib.median() / one.peak_mib.median():.2f}",
                )
            )
    yield Table(
        name="ranks",
        head=("case", "solver", "tol", "ranks", "alone", "solve", "speed-up", "memory"),
        rows=tuple(lines),
        caption="Median solve times, speed-up with its 95 % interval over repeats, and "
        "memory of all ranks relative to one rank.",
        texts=2,
    )  # fmt: skip
