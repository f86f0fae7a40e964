"""Changes between two runs, or between two solvers of one run, and their judgement.

A cell is a case at a tolerance. For each solver, the geometric mean of the ratios of
its times after and before is taken over the cells that were verified both times. The
cells are fixed; the error of the mean is due to the noise of the repeats, and its
interval is Welch's [1]_: the squared errors of the cells add, with the degrees of
freedom of Satterthwaite. Repeats of one run are paired, since the solvers of a repeat
follow each other; repeats of two runs are not. The error of the processes, which the
repeats of a run share, is added (`reports.intervals`).

References
----------
.. [1] B. L. Welch, The generalization of 'Student's' problem when several different
   population variances are involved, Biometrika 34 (1947) 28-35

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from mortarbench.reports.document import interval, number, plural
from mortarbench.reports.intervals import Array, Interval, student, widened
from mortarbench.reports.measurements import CELL, SEVERITY, Measurements

#: Factor from the half-width of a 95 % interval to 99 % (normal distribution). To pass
#: a slower solver is worse than not to decide.
PASSED = 1.31
MOST_REPEATS = 10_000  #: largest number of repeats that is recommended


class Outcome(Enum):
    """Judgement on the speed of a solver, with the exit code of the command."""

    NOT_SLOWER = 0
    SLOWER = 1
    CANNOT_TELL = 2


def judged(ratio: Interval | None, limit: float) -> Outcome:
    """Judge a ratio of times: slower, not slower, or undecided.

    A solver is slower if the ratio is at least `limit` and its interval excludes 1, and
    not slower if its 99 % interval lies below `limit`.
    """
    if ratio is None or not ratio.is_known:
        return Outcome.CANNOT_TELL
    if ratio.value >= limit and ratio.low > 1:
        return Outcome.SLOWER
    high = ratio.value * (ratio.high / ratio.value) ** PASSED
    return Outcome.NOT_SLOWER if high < limit else Outcome.CANNOT_TELL


@dataclass(frozen=True, eq=False, kw_only=True)
class Change:
    """Change of one solver."""

    before: str  #: label before
    after: str  #: label after
    ratio: Interval | None  #: time after relative to before; None without common cells
    busy: bool  #: True if other programs occupied the machine in one of two runs
    other_machine: bool  #: True if common cells have times, but of other machines
    cells: int  #: number of cells with a ratio
    repeats: float  #: mean number of repeats of these cells
    sessions: int  #: number of sessions after, at most that before
    by_cell: pd.DataFrame  #: ratio of each cell, from the largest
    #: cells whose status changed, with the statuses `old` and `new`
    statuses: pd.DataFrame

    @property
    def name(self) -> str:
        """Label of the solver, or both labels."""
        same = self.before == self.after
        return self.after if same else f"{self.after} (before: {self.before})"

    @property
    def worse(self) -> pd.DataFrame:
        """Cells whose status became worse."""
        return self.statuses[self.statuses.turn < 0]

    def outcome(self, limit: float) -> Outcome:
        """Judge whether the solver is slower than before by the factor `limit`."""
        return Outcome.CANNOT_TELL if self.busy else judged(self.ratio, limit)

    def sentence(self, limit: float) -> str:
        """Return the judgement with its numbers in one line."""
        if self.other_machine:
            return f"cannot tell: {self.name} was measured on another machine"
        if self.ratio is None:
            return f"cannot tell: {self.name} has no cell that was verified both times"
        measured = f"{number(self.ratio.value)} × {interval(self.ratio, 3)}".strip()
        over = f"{measured} over {plural(self.cells, 'cell')}"
        match self.outcome(limit):
            case Outcome.SLOWER:
                return f"slower: {self.name} takes {over}, limit {limit:g}"
            case Outcome.NOT_SLOWER:
                return f"not slower: {self.name} takes {over}, below {limit:g}"
        return f"cannot tell: {self.name} takes {over}; {self._advice(limit)}"

    def _advice(self, limit: float) -> str:
        if self.busy:
            return "other programs were running; compare both versions in one run"
        assert self.ratio is not None
        if not self.ratio.is_known:
            return "a single repeat has no interval; use --repeats 7"
        half = float(np.log(self.ratio.high / self.ratio.value))
        least = f"the smallest detectable factor here is {number(float(np.exp(half)))}"
        process = widened(0.0, self.sessions)
        if half**2 < 2 * process**2:  # more repeats in these processes would not help
            runs = int(np.ceil(2 * self.sessions * (process / np.log(limit)) ** 2))
            return f"{least}; merge {max(runs, 2 * self.sessions)} runs"
        needed = self.repeats * (half / np.log(limit)) ** 2
        # the mean itself may be close to the limit
        more = int(min(np.ceil(max(needed, 2 * self.repeats)), MOST_REPEATS))
        return f"{least}; run again with --repeats {more}"


def compare(
    before: Measurements, after: Measurements, pairs: Sequence[tuple[str, str]]
) -> list[Change]:
    """Compare solvers in two folders, or in one folder given twice.

    pairs : labels before and after
    """
    paired = before.folder == after.folder
    return [_change(before, after, *pair, paired=paired) for pair in pairs]


def _change(
    before: Measurements, after: Measurements, old: str, new: str, *, paired: bool
) -> Change:
    a, b = (
        run.answers[run.answers.solver == label].drop_duplicates(CELL)
        for run, label in ((before, old), (after, new))
    )
    both = a.merge(b, on=CELL, suffixes=("_old", "_new"))
    statuses = both[both.severity_old != both.severity_new]
    statuses = pd.DataFrame(
        {
            **{name: statuses[name] for name in CELL},
            "old": [SEVERITY[i].value for i in statuses.severity_old],
            "new": [SEVERITY[i].value for i in statuses.severity_new],
            "turn": statuses.severity_new - statuses.severity_old,
        }
    )
    verified = both[both.verified_old & both.verified_new]
    cells = set(verified[CELL].itertuples(index=False, name=None))
    machines = _machines(before, after)
    x, y = _logs(before, old, machines), _logs(after, new, machines)
    ratios = {
        key: _ratio(x[key], y[key], paired=paired)
        for key in x
        if key in y and key[1:] in cells
    }
    sessions = min(
        len({session for key in ratios for session, _ in logs[key].index})
        for logs in (x, y)
    )
    mean = mean_ratio(list(ratios.values()), sessions)
    by_cell = pd.DataFrame(
        [(*key, np.exp(r.mean), r.repeats) for (_, *key), r in ratios.items()],
        columns=[*CELL, "ratio", "repeats"],
    ).sort_values("ratio", ascending=False, ignore_index=True)
    return Change(
        before=old,
        after=new,
        ratio=mean,
        cells=len(ratios),
        repeats=float(by_cell.repeats.mean()) if ratios else 0.0,
        sessions=sessions,
        busy=not paired and (_busy(before) or _busy(after)),
        other_machine=bool(cells) and not ratios,
        by_cell=by_cell,
        statuses=statuses,
    )


class CellRatio(NamedTuple):
    """Logarithm of the ratio of the times of one cell."""

    mean: float
    square: float  #: squared standard error; NaN for single repeats
    freedom: float
    repeats: float


def _busy(run: Measurements) -> bool:
    """Return True if a run began with more running processes than cores."""
    for environment in run.environments.values():
        load: Any = (environment.get("now") or {}).get("load")
        cores: Any = (environment.get("machine") or {}).get("usable_cores")
        if all(isinstance(v, int | float) for v in (load, cores)) and load > cores:
            return True
    return False


def _machines(before: Measurements, after: Measurements) -> dict[str, str]:
    """Map the environments of `after` to those of `before` on the same machine."""
    known = {digest: digest for digest in before.df.environment}
    for digest, one in after.environments.items():
        for other, earlier in before.environments.items():
            if one and one.get("machine") == earlier.get("machine"):
                known.setdefault(digest, other)
    return known


def _logs(
    run: Measurements, label: str, machines: dict[str, str]
) -> dict[tuple[Any, ...], pd.Series]:
    """Return log times by machine and cell, indexed by session and repeat."""
    df = run.df[(run.df.solver == label) & (run.df.total_seconds > 0)]
    df = df.assign(machine=df.environment.map(machines))
    return {
        key: pd.Series(
            np.log(of.total_seconds.to_numpy()),
            index=pd.MultiIndex.from_frame(of[["session", "repeat"]]),
        )
        for key, of in df.groupby(["machine", *CELL], sort=False)
    }


def _ratio(x: pd.Series, y: pd.Series, *, paired: bool) -> CellRatio:
    if paired:
        d = (y - x).dropna().to_numpy()
        if d.size:
            square = d.var(ddof=1) / d.size if d.size > 1 else np.nan
            return CellRatio(float(d.mean()), float(square), d.size - 1, d.size)
    return welch(x.to_numpy(), y.to_numpy())


def welch(x: Array, y: Array) -> CellRatio:
    """Return the difference of the means y − x with Welch's error."""
    parts = [v.var(ddof=1) / v.size if v.size > 1 else np.nan for v in (x, y)]
    square = sum(parts)
    freedom = (
        square**2
        / sum(
            part**2 / (v.size - 1) if v.size > 1 else np.nan
            for part, v in zip(parts, (x, y), strict=True)
        )
        if square > 0
        else min(x.size, y.size) - 1.0
    )
    mean = float(y.mean() - x.mean())
    return CellRatio(mean, float(square), float(freedom), min(x.size, y.size))


def mean_ratio(ratios: Sequence[CellRatio], sessions: int) -> Interval | None:
    """Return the geometric mean over cells; without an interval for single repeats."""
    if not ratios:
        return None
    mean = float(np.mean([r.mean for r in ratios]))
    squares = np.array([r.square for r in ratios]) / len(ratios) ** 2
    square, half = float(squares.sum()), np.nan
    if np.isfinite(square):
        parts = squares**2 / [max(r.freedom, 1.0) for r in ratios]
        freedom = square**2 / parts.sum() if square > 0 else 1.0
        half = widened(student(float(freedom)) * float(np.sqrt(square)), sessions)
    low, value, high = np.exp(mean + np.array([-half, 0.0, half]))
    return Interval(float(value), float(low), float(high))
