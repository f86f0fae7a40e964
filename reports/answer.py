"""The first screen: which solver is the fastest for each form and accuracy.

If a suite measures several tolerances, solvers are compared at equal accuracy: the time
of a solver on a case is that of the loosest tolerance whose answer has at most the
error of the row. Otherwise, a solver with a weak stopping test would look fast.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd

from mortarbench.reports.document import (
    ABSENT,
    Table,
    accuracy_text,
    interval,
    number,
    plural,
    short,
    short_name,
)
from mortarbench.reports.intervals import Interval, Pooled, PowerLaw, pooled, power_law
from mortarbench.reports.measurements import KEY, Measurements, in_order

COMPLETE = 0.9  #: share of the cases that a solver must solve to be named fastest
BETTER = 3  #: factor by which the repeats would grow that a sentence recommends
LEAST_ADVISED = 9  #: smallest number of repeats that a sentence recommends
#: part of the present half-width below which more repeats count as useful
USEFUL = 0.9


class Entry(NamedTuple):
    """Result of one solver in a row of the first screen."""

    solver: str
    time: (
        Pooled | None
    )  #: time relative to the fastest solver; None without a common case
    met: int  #: number of cases that the solver solved with the accuracy of the row
    cases: int  #: number of cases of the row
    growth: PowerLaw | None  #: time against m
    tier: int = 0  #: 1 for the fastest solver; 0 for a solver that does not compete
    note: str = ""  #: reason for the absence of a time, such as "declined"


@dataclass(frozen=True, eq=False, kw_only=True)
class Row:
    """Comparison of the solvers on all cases of one form at one accuracy."""

    form: str
    accuracy: float
    by_error: bool  #: True if `accuracy` is an error, False if it is a tolerance
    entries: tuple[Entry, ...]  #: from the fastest solver to the slowest
    chosen: pd.DataFrame  #: the compared answers, one row per case and solver

    @property
    def label(self) -> str:
        """Accuracy in words: "error 1e-6" or "tol 1e-8"."""
        return accuracy_text(self.accuracy, by_error=self.by_error)

    @property
    def ranked(self) -> tuple[Entry, ...]:
        """The entries with a time."""
        return tuple(e for e in self.entries if e.time is not None)


def with_errors(answers: pd.DataFrame) -> pd.DataFrame:
    """Add the column `error`, an error relative to the solution, in the energy norm.

    The error is the certified bound. Without mechanics it is √(|f − f*|/|f*|), where
    f* is the objective of the verified answer to the same QP with the least residual.
    """
    verified = answers[answers.verified & answers.objective.notna()]
    best = verified.sort_values("residual").groupby("case").objective.first()
    least = answers.case.map(best).astype(float)
    apart = np.sqrt((answers.objective - least).abs() / least.abs().where(least != 0))
    certified = answers.groupby("case").energy_bound.transform("count") > 0
    return answers.assign(error=answers.energy_bound.where(certified, apart))


def rows(run: Measurements) -> Iterator[Row]:
    """Yield the rows of the first screen: forms, each from the loosest accuracy on."""
    answers = run.answers
    answers = with_errors(answers[answers.arm != "null"])
    modes = set(answers["mode"])
    answers = answers[answers["mode"] == ("cold" if "cold" in modes else min(modes))]
    answers = answers[answers.ranks == answers.ranks.min()]
    tolerances = sorted(set(answers.tol), reverse=True)
    for form in in_order(answers.form, ("primal", "dual", "dual-bounds")):
        of_form = answers[answers.form == form]
        by_error = len(tolerances) > 1 and bool(of_form.error.notna().any())
        for accuracy in tolerances:
            if by_error:
                good = of_form[of_form.verified & (of_form.error <= accuracy)]
                good = good.sort_values("tol", ascending=False, kind="stable")
                good = good.drop_duplicates(["case", "solver"])
            else:
                good = of_form[of_form.verified & (of_form.tol == accuracy)]
            if by_error and good.solver.nunique() < 2 < of_form.solver.nunique():
                continue  # no comparison: hardly a solver is so accurate
            yield row_of(run, of_form, good, form, accuracy, by_error=by_error)


def row_of(
    run: Measurements,
    every: pd.DataFrame,
    good: pd.DataFrame,
    form: str,
    accuracy: float,
    *,
    by_error: bool,
) -> Row:
    """Compare the solvers on the cases of one form at one accuracy.

    every : all answers, one row per case, solver and tolerance
    good : those with the accuracy, one row per case and solver
    """
    cases, labels = every.case.nunique(), in_order(every.solver, run.solvers)
    timed = good[(good.total_seconds > 0) & ~good.remembered]
    logs = _logs(run.df, timed)
    means = timed.pivot_table("total_seconds", "case", "solver", "first")
    first = fastest(np.log(means))
    first = _first_by_pairs(logs, means, first)
    entries = []
    for solver in labels:
        mine = every[every.solver == solver]
        time, note = None, ""
        if first and solver in means:
            both = means.index[means[[first, solver]].notna().all(axis=1)]
            time = compared(logs, first, solver, both) if len(both) else None
            if time and solver == first:
                time = time._replace(ratio=Interval(1.0, 1.0, 1.0))
        elif (mine.status == "declined").all():
            note = "declined"
        elif mine.remembered.any():
            note = "reuses answers"
        met = int((good.solver == solver).sum())
        growth = growth_of(timed[timed.solver == solver])
        entries.append(Entry(solver, time, met, cases, growth, note=note))
    entries.sort(
        key=lambda e: (e.time is None, e.solver != first, e.time and e.time.ratio.value)
    )
    return Row(
        form=form,
        accuracy=accuracy,
        by_error=by_error,
        entries=tuple(_in_tiers(entries, logs, means)),
        chosen=good,
    )


def _in_tiers(
    entries: Iterable[Entry], logs: Logs, means: pd.DataFrame
) -> Iterator[Entry]:
    """Yield the entries with their tiers; they are given from the fastest on.

    A solver begins the next tier if the interval of its time relative to the first
    solver of the tier is above 1, on the cases that both solved.
    """
    leader, tier = "", 0
    for e in entries:
        if e.time is None or e.met < COMPLETE * len(means):
            yield e
            continue
        both = means.index[means[[leader or e.solver, e.solver]].notna().all(axis=1)]
        if not leader or compared(logs, leader, e.solver, both).ratio.low > 1:
            leader, tier = e.solver, tier + 1
        yield e._replace(tier=tier)


def _first_by_pairs(logs: Logs, means: pd.DataFrame, first: str) -> str:
    """Return the solver with the least ratio to `first` of those that compete."""
    solved = means.notna().sum()
    ratios = {
        solver: compared(logs, first, solver, both).ratio.value
        for solver in means
        if first and solved[solver] >= COMPLETE * len(means)
        for both in [means.index[means[[first, solver]].notna().all(axis=1)]]
        if len(both)
    }
    return min(ratios, key=lambda solver: ratios[solver], default=first)


def fastest(logs: pd.DataFrame) -> str:
    """Return the solver with the least mean over the cases, or "" if there is none.

    Solvers compete if they solved at least the share `COMPLETE` of the cases that any
    solver solved; their means are over the cases that all of them solved.

    logs : logarithms of times; cases as rows, solvers as columns, NaN for unsolved
    """
    if logs.empty:
        return ""
    solved = logs.notna().sum()
    logs = logs[solved.index[solved >= COMPLETE * len(logs)]]
    if logs.empty:
        return str(solved.idxmax())
    common = logs.dropna()
    return str((common if len(common) else logs).mean().idxmin())


#: log times by case and solver, then by session and repeat
Logs = Mapping[tuple[str, str], Mapping[tuple[str, int], float]]


def _logs(df: pd.DataFrame, chosen: pd.DataFrame) -> Logs:
    """Return the log times of the chosen answers."""
    times = df.merge(chosen[KEY], on=KEY)
    times = times[times.total_seconds > 0]
    logs: dict[tuple[str, str], dict[tuple[str, int], float]] = {}
    columns = ("case", "solver", "session", "repeat")
    for case, solver, session, repeat, log in zip(
        *(times[c] for c in columns), np.log(times.total_seconds), strict=True
    ):
        logs.setdefault((case, solver), {})[session, repeat] = log
    return logs


def compared(logs: Logs, first: str, other: str, cases: Iterable[str]) -> Pooled:
    """Pool the time of a solver relative to another, paired by session and repeat.

    Measurements of one repeat follow each other in time, so that a disturbance that
    affects both cancels. Without common repeats, the median of `first` is used.
    """
    differences, sessions = [], set()
    for case in cases:
        a, b = logs[case, other], logs[case, first]
        sessions |= {session for session, _ in a}
        paired = [log - b[key] for key, log in a.items() if key in b]
        middle = 0.0 if paired else float(np.median([*b.values()]))
        differences.append(paired or [log - middle for log in a.values()])
    return pooled(differences, len(sessions))


def growth_of(answers: pd.DataFrame, size: str = "m") -> PowerLaw | None:
    """Fit time against size, with one factor for each series of equal other keys."""
    known = answers[answers[size] > 0]
    return power_law(
        [(of[size], of.total_seconds) for _, of in known.groupby("series")]
    )


def decisive(found: Sequence[Row]) -> list[Row]:
    """Return for each form its most accurate row with enough answers, else the last.

    Enough: the fastest solver solved at least the share `COMPLETE` of the cases.
    """
    chosen: dict[str, Row] = {}
    for row in found:  # from the loosest accuracy on
        first = next(iter(row.ranked), None)
        if row.form not in chosen or (first and first.met >= COMPLETE * first.cases):
            chosen[row.form] = row
    return [*chosen.values()]


def sentence(row: Row) -> str:
    """Return the conclusion of a row: "smalbe fastest; daqp 3.6 × [2.1, 6.2]"."""
    ranked, start = row.ranked, f"{short_name(row.form) or 'QP'}, {row.label}: "
    if not ranked:
        return f"{start}no solver reached this accuracy on any case"
    first, others = ranked[0], ranked[1:]
    name = short_name(first.solver)
    partly = f" (on {first.met} of {first.cases} cases)" * (first.met < first.cases)
    if not others:
        return f"{start}only {name} reached it{partly}"
    slower = [e for e in others if e.time and e.time.ratio.low > 1]
    tied = [e for e in others if e not in slower and e.met >= first.met]
    following = (
        f"{short_name(slower[0].solver)} {short(slower[0].time)}" if slower else ""
    )
    if not tied:
        return (
            f"{start}{name} fastest{partly}; {following}"
            if slower
            else (f"{start}{name} fastest{partly}; the others solved fewer cases")
        )
    names = ", ".join(f"{short_name(e.solver)} {short(e.time)}" for e in tied[:2])
    more = f" and {len(tied) - 2} more" * (len(tied) > 2)
    return (
        f"{start}cannot tell {name} from {names}{more} {advice(tied[0].time)}"
        + f"; then {following}" * bool(slower)
    )


def advice(time: Pooled | None) -> str:
    """Return the repeats of a comparison, and what more repeats would achieve."""
    assert time is not None
    made = round(time.repeats)
    more = max(BETTER * made, LEAST_ADVISED)
    at = f"at {plural(made, 'repeat')}"
    factor, now = time.separable(more), time.separable(made) if made > 1 else np.inf
    if not np.isfinite(factor):
        return f"{at}; use --repeats {more}"
    if np.log(factor) > USEFUL * np.log(now):
        return f"{at}: the ratio differs between cases, so that more cases would help"
    return f"{at}; {more} would separate factors above {factor:.2g}"


def table(found: Sequence[Row], solvers: Sequence[str]) -> Table:
    """Return the table of the first screen."""
    shown = [s for s in solvers if any(e.solver == s for r in found for e in r.entries)]
    lines, data = [], []
    for row in found:
        by_solver = {e.solver: e for e in row.entries}
        cells = [_cell(by_solver.get(s)) for s in shown]
        lines.append((short_name(row.form) or "QP", row.label, *cells))
        for e in row.entries:
            ratio = e.time.ratio if e.time else (None,) * 3
            law = e.growth.exponent if e.growth else (None,) * 3
            data.append(
                (row.form, row.accuracy, e.solver, *ratio, e.met, e.cases, *law)
            )
    return Table(
        name="answer",
        head=("form", "accuracy", *map(short_name, shown)),
        rows=tuple(lines),
        caption="Time relative to the fastest solver of the row: geometric mean over "
        "the cases with its 95 % interval (Student's, over cases; over repeats of a "
        "single case). Below: cases solved with this accuracy, and the exponent p of "
        "time ∝ mᵖ, m the size of the dual. Solvers with fewer than 90 % of the cases "
        "do not compete; they are compared on the cases that they solved.",
        data=pd.DataFrame(
            data,
            columns=[
                "form",
                "accuracy",
                "solver",
                "ratio",
                "low",
                "high",
                "met",
                "cases",
                "exponent",
                "exponent_low",
                "exponent_high",
            ],
        ),
    )


def _cell(e: Entry | None) -> str:
    if e is None:
        return ""
    below = f"{e.met}/{e.cases}"
    if e.time is None:
        return e.note or f"{ABSENT}\n{below}"
    if e.growth:
        below += f" · m^{e.growth.exponent.value:.1f}"
    ratio = e.time.ratio
    if ratio.low == ratio.value == 1:
        return f"1 (fastest)\n{below}"
    ends = [interval(ratio)] * ratio.is_known
    return "\n".join([f"{number(ratio.value, 2)} ×", *ends, below])
