"""Sections on answers of solvers: outcomes, times, scaling, iterations, accuracy."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
import pandas as pd

from mortarbench.harness import InputError, Verdict
from mortarbench.harness.files.store import load_solution
from mortarbench.harness.record import PROVEN, REFUTED
from mortarbench.harness.solution import History, Status
from mortarbench.reports.answer import Row, growth_of, with_errors
from mortarbench.reports.document import (
    ABSENT,
    Item,
    Picture,
    Table,
    clean,
    law,
    number,
    plural,
    seconds,
    short_name,
    stem,
    tolerance,
)
from mortarbench.reports.figures import curves
from mortarbench.reports.intervals import median_interval, power_law
from mortarbench.reports.measurements import (
    CELL,
    Measurements,
    in_order,
    series_of,
)

GROUPS = {
    "verified": (Verdict.VERIFIED, *PROVEN),
    "inaccurate": (Verdict.INACCURATE,),
    "wrong": (Verdict.WRONG,),
    "unproven claim": (Verdict.INFEASIBLE_CLAIM, Verdict.UNBOUNDED_CLAIM),
    "limit": (Verdict.ITERATION_LIMIT, Verdict.TIME_LIMIT, Verdict.MEMORY_LIMIT),
    "failed": (Verdict.CRASHED, Verdict.FAILED),
    "declined": (Verdict.DECLINED,),
}  # fmt: skip
MOST_FAILURES = 12  #: largest number of rows in the table of failures
MOST_SIZES = 5  #: largest number of sizes in a table of times
MOST_HISTORIES = 2  #: largest number of cases whose histories are drawn
LEAST_PROFILE = 4  #: smallest number of cases of a performance profile


def outcomes(run: Measurements, rows: list[Row]) -> Iterator[Item]:
    """Count the statuses of every solver, and list what was wrong."""
    del rows
    df = run.df
    made = df[df.status != Verdict.DECLINED]
    yield (
        f"{len(made)} measurements of {plural(df.solver.nunique(), 'solver')} on "
        f"{plural(df.case.nunique(), 'case')}; {int(df.verified.sum())} answers "
        f"verified, {plural(int(df.status.isin(REFUTED).sum()), 'claim')} refuted."
    )
    counts = {
        solver: [int(of.status.isin(group).sum()) for group in GROUPS.values()]
        for solver, of in df.groupby("solver")
    }
    yield Table(
        name="outcomes",
        head=("solver", *GROUPS),
        rows=tuple(
            (short_name(s), *(str(c or "") for c in counts[s])) for s in run.solvers
        ),
        caption="Measurements by status.",
    )
    bad = df[~df.verified & (df.status != Verdict.DECLINED)]
    if bad.empty:
        return
    groups = sorted(
        bad.groupby(["solver", "form", "status"], sort=False),
        key=lambda group: -len(group[1]),
    )
    yield Table(
        name="failures",
        head=("solver", "form", "status", "message", "to repeat", "measurements"),
        rows=tuple(
            (
                short_name(solver), clean(form, 24), status.replace("_", " "),
                clean(of.message.mode().iloc[0], 90),
                clean(f"{of.session.iloc[0]}-{of.run_id.iloc[0]}".strip("-"), 60),
                str(len(of)),
            )
            for (solver, form, status), of in groups[:MOST_FAILURES]
        ),
        caption="What was wrong, with the most frequent message; the measurement in "
        "the column “to repeat” is repeated by mortarbench replay DIR ID."
        + f" {len(groups) - MOST_FAILURES} more kinds are in the journal."
        * (len(groups) > MOST_FAILURES),
        texts=5,
    )  # fmt: skip


def tightest(answers: pd.DataFrame) -> pd.DataFrame:
    """Return the cold answers of ordinary solvers at the tightest tolerance."""
    answers = answers[(answers["mode"] == "cold") & (answers.arm != "null")]
    return answers[answers.tol == answers.tol.min()]


def times(run: Measurements, rows: list[Row]) -> Iterator[Item]:
    """Tabulate times by size for each form, and draw performance profiles."""
    del rows
    answers = tightest(run.answers)
    for form, of in answers.groupby("form", sort=False):
        yield _times_of(run, str(form), of)
    of_case = answers.groupby("form").case.nunique()
    shown = answers[answers.form.isin(of_case.index[of_case >= LEAST_PROFILE])]
    if not shown.empty and shown.verified.any():
        yield Picture(
            name="profiles",
            caption="Performance profiles: share of the cases that a solver solved "
            "within τ times the time of the fastest solver of the case.",
            draw=partial(curves.profiles, shown, run.solvers),
        )


def _times_of(run: Measurements, form: str, of: pd.DataFrame) -> Table:
    of = of.assign(m=of.m.fillna(0))
    sizes = sorted(set(of.m))
    if len(sizes) > MOST_SIZES:
        places = np.linspace(0, len(sizes) - 1, MOST_SIZES).round().astype(int)
        sizes = [sizes[i] for i in places]
    raw = run.df.merge(of[[*CELL, "environment", "solver"]])
    lines = []
    for solver in (s for s in run.solvers if s in set(of.solver)):
        mine = of[of.solver == solver]
        if (mine.status == Verdict.DECLINED).all():
            continue
        cells = [_time(mine[mine.m == m], raw[raw.solver == solver]) for m in sizes]
        solved = mine[mine.verified & (mine.total_seconds > 0)]
        count = solved.iterations.median()
        error = solved.energy_bound.max()
        lines.append(
            (
                short_name(solver),
                *cells,
                number(count) if np.isfinite(count) else ABSENT,
                number(error, 1),
                law(growth_of(solved)).replace(" ", "\n", 1),
            )
        )
    tol, named = tolerance(float(of.tol.min())), short_name(form) or "QP"
    return Table(
        name=f"times-{stem(form) or 'qp'}",
        head=("solver", *(f"m = {m:.0f}" for m in sizes), "iter.", "error", "p"),
        rows=tuple(lines),
        caption=f"Form {named}, tolerance {tol}: median time of preparation and "
        "solve by the size m of the dual, with the 95 % interval of the median below "
        "(range of fewer than six repeats; geometric mean if several cases have this "
        "size). Iterations: median; error: largest certified error, relative, in the "
        "energy norm; p: exponent of time ∝ mᵖ. A status in place of a time: not "
        "verified.",
        data=of[
            ["form", "case", "solver", "tol", "n", "m", "status", "total_seconds",
             "prepare_seconds", "solve_seconds", "iterations", "energy_bound"]
        ],
    )  # fmt: skip


def _time(at: pd.DataFrame, raw: pd.DataFrame) -> str:
    """Return the time of the answers at one size, with its interval, or the status."""
    if at.empty:
        return ""
    if not at.verified.all():
        worst = at.sort_values("severity").status.iloc[0]
        return str(worst).replace("_", " ")
    if at.remembered.any():
        return "reuses answers"
    if len(at) > 1:
        return seconds(float(np.exp(np.log(at.total_seconds).mean())))
    samples = raw[raw.case == at.case.iloc[0]].total_seconds.dropna()
    if samples.empty:
        return "verified, not timed"
    middle = median_interval(samples)
    if len(samples) < 2:
        return seconds(middle.value)
    shown = seconds(middle.value)
    scale = middle.value / float(shown.split()[0])
    low, high = (number(end / scale, 2) for end in (middle.low, middle.high))
    return f"{shown}\n[{low}, {high}]"


def scaling(run: Measurements, rows: list[Row]) -> Iterator[Item]:
    """Plot and fit times against size; plot condition numbers."""
    del rows
    answers = tightest(run.answers)
    solved = answers[answers.verified & (answers.total_seconds > 0)]
    fits = []
    for form, of in solved.groupby("form", sort=False):
        for solver in (s for s in run.solvers if s in set(of.solver)):
            mine = of[of.solver == solver]
            by_m, by_n = growth_of(mine, "m"), growth_of(mine, "n")
            if by_m or by_n:
                sizes = _span(mine.m)
                fits.append(
                    (
                        short_name(str(form)),
                        short_name(solver),
                        sizes,
                        law(by_n),
                        law(by_m),
                    )
                )
    if fits:
        yield Table(
            name="exponents",
            head=("form", "solver", "m", "against n", "against m"),
            rows=tuple(fits),
            caption="Exponents p of time ∝ nᵖ (degrees of freedom) and time ∝ mᵖ (size "
            f"of the dual) at tolerance {tolerance(float(solved.tol.min()))}, with "
            "Student's 95 % intervals; verified answers only.",
            texts=2,
        )
        if curves.against(solved, run.solvers) is not None:
            yield Picture(
                name="scaling",
                caption="Time of preparation and solve against the size of the dual; "
                "lines connect medians over the cases of equal size.",
                draw=partial(_drawn, curves.against, solved, run.solvers),
            )
    yield from _condition(run)


def _drawn(draw: Any, *arguments: Any) -> Any:
    """Call a function that returns a figure for these arguments."""
    return draw(*arguments)


def _condition(run: Measurements) -> Iterator[Item]:
    answers = run.answers[run.answers.verified]
    tables = [q if isinstance(q, dict) else {} for q in answers.quantities]
    names = dict.fromkeys(
        name
        for q in tables
        for name, value in q.items()
        if name.startswith("kappa") and not name.endswith("_error")
        and isinstance(value, int | float)
    )  # fmt: skip
    if not names:
        return
    answers = answers.assign(
        feti=[p.get("feti", p.get("parts", 0)) for p in answers.params],
        **{name: [q.get(name, np.nan) for q in tables] for name in names},
    )
    x = "feti" if answers.feti.nunique() > 2 else "n"
    kept = answers if x == "n" else answers[answers.feti > 0]
    kept = kept.assign(series=series_of(kept))
    yield Picture(
        name="kappa",
        caption="Condition numbers that the cases report, against "
        + ("the degrees of freedom." if x == "n" else "H/h, cells along a subdomain."),
        draw=partial(
            curves.condition, kept.assign(series=series_of(kept)), x, list(names)
        ),
    )


def iterations(run: Measurements, rows: list[Row]) -> Iterator[Item]:
    """Tabulate and plot iterations and products, and plot histories."""
    del rows
    answers = tightest(run.answers)
    solved = answers[answers.verified & answers.iterations.notna()]
    lines = []
    for form, of in solved.groupby("form", sort=False):
        for solver in (s for s in run.solvers if s in set(of.solver)):
            mine = of[of.solver == solver]
            fit = power_law(
                [
                    (o.m, o.iterations)
                    for _, o in mine[(mine.iterations > 0) & (mine.m > 0)].groupby(
                        "series"
                    )
                ]
            )
            lines.append(
                (
                    short_name(str(form)),
                    short_name(solver),
                    _span(mine.iterations),
                    _span(mine.products),
                    law(fit),
                )
            )
    if lines:
        yield Table(
            name="iterations",
            head=("form", "solver", "iterations", "products with P", "exponent in m"),
            rows=tuple(lines),
            caption="Iterations as each solver counts them, and products with P where "
            "a solver counts them: range over the verified cases.",
            texts=2,
        )  # fmt: skip
        if curves.against(solved, run.solvers, "m", "iterations") is not None:
            yield Picture(
                name="iterations",
                caption="Iterations against the size of the dual.",
                draw=partial(
                    _drawn, curves.against, solved, run.solvers, "m", "iterations"
                ),
            )
    for k, (case, tol, found) in enumerate(_histories(run), 1):
        title = f"{case}, tol {tolerance(tol)}"
        yield Picture(
            name=f"history-{k}",
            caption=f"Convergence on {clean(title)}. Marks: "
            + ", ".join(f"{m[0]} {m[1]}" for m in curves.STEPS.values())
            + " steps. Each solver uses its own norms; verdicts do not depend on them.",
            draw=partial(curves.histories, found, run.solvers, title),
        )


def _span(values: Iterable[float]) -> str:
    known = [v for v in values if np.isfinite(v)]
    if not known:
        return ABSENT
    low, high = (f"{v:.0f}" for v in (min(known), max(known)))
    return low if low == high else f"{low}–{high}"


def _histories(run: Measurements) -> Iterator[tuple[str, float, dict[str, History]]]:
    """Yield the stored histories of the largest case of each form."""
    stored = run.df[run.df.vectors.notna()]
    recorded = np.array([bool(o.get("history")) for o in stored.options], dtype=bool)
    stored = stored[recorded].sort_values(["m", "tol"], ascending=[False, True])
    groups = stored.groupby(["family", "form"], sort=False)
    for _, of in islice(groups, MOST_HISTORIES):
        case, tol = of.case.iloc[0], float(of.tol.iloc[0])
        found: dict[str, History] = {}
        here = of[(of.case == case) & (of.tol == tol)].drop_duplicates("solver")
        for solver, vectors in zip(here.solver, here.vectors, strict=True):
            with suppress(InputError):  # a report needs only the journal
                history = load_solution(run.folder, vectors, Status.SOLVED).history
                if history and len(next(iter(history.values()))):
                    found[str(solver)] = history
        if found:
            yield str(case), tol, found


def accuracy(run: Measurements, rows: list[Row]) -> Iterator[Item]:
    """Tabulate residuals and certified errors, and plot errors against times."""
    del rows
    answers = with_errors(run.answers[run.answers.verified])
    answers = answers[answers.residual.notna()]
    if answers.empty:
        return
    keys = ["form", "solver", "tol"]
    units = answers.assign(residual=answers.residual / answers.tol)
    data = units.groupby(keys, sort=False).agg(
        cases=("case", "nunique"), residual=("residual", "max"),
        error=("error", "median"), largest=("error", "max"),
    )  # fmt: skip
    tolerances = sorted(set(answers.tol), reverse=True)
    rows_of = {(form, s) for form, s, _ in data.index}
    yield Table(
        name="accuracy",
        head=("form", "solver", *(f"tol {tolerance(t)}" for t in tolerances)),
        rows=tuple(
            (
                short_name(form),
                short_name(s),
                *(_accuracy(data, (form, s, t)) for t in tolerances),
            )
            for form in in_order(answers.form, ("primal", "dual"))
            for s in run.solvers
            if (form, s) in rows_of
        ),
        caption="Error of the verified answers, relative to the solution in the energy "
        "norm (certified bound where the case has mechanics): median over the cases. "
        "Below: largest error, and largest KKT residual in units of the tolerance.",
        data=data.reset_index(),
        texts=2,
    )
    if (answers.error > 0).any():
        yield Picture(
            name="accuracy",
            caption="Error against time, a curve over the tolerances for each solver: "
            "medians over the cases that the solver solved at every tolerance.",
            draw=partial(_drawn, curves.accuracy, answers, run.solvers),
        )


def _accuracy(data: pd.DataFrame, key: tuple[str, str, float]) -> str:
    if key not in data.index:
        return ABSENT
    of = data.loc[key]
    below = f"≤ {number(of.largest, 2)}; {number(of.residual, 2)} tol"
    return f"{number(of.error, 2)}\n{below}"
