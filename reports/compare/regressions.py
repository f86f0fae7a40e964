"""Solvers that became slower, with enough certainty to fail a CI job.

Two runs of the same code yield different times, because the speed of the machine varies
with time, and differently for each case. A slowdown is therefore reported only if two
intervals lie entirely above 1: the interval of the ratio after / before, and the
interval of this ratio relative to the other solvers in the same blocks, which cancels a
common slowdown.
Both intervals are unpaired between the folders, which are different sessions.

- Solver: mean of the logarithms over its cases (at least three), with Student's
  interval. The scatter over cases includes the differences between runs on one case.
- Single cell: Welch's interval over the repeats. The standard error of the relative
  ratio is the larger of Welch's error and the scatter of the cells about the medians of
  their solvers (1.4826 times the median distance, which is the standard deviation of a
  normal law). At least `CELLS` cells are needed to estimate the scatter.

The intervals of the ratios after / before have a joint coverage of at least 95 %, and
so have the intervals of the relative ratios: half of the error probability of 5 % is
assigned to the solvers and half to the cells, and each half is divided evenly
(Bonferroni) [1]_.

References
----------
.. [1] R. G. Miller, Simultaneous Statistical Inference, 2nd ed., 1981, §1.3, 2.1

"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from mortarbench.harness.running.pairs import Ratio, unpaired_ratio
from mortarbench.reports.compare.changes import FEWEST, Comparison, block_of
from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.document.grouping import grouped
from mortarbench.reports.statistics.intervals import COVERAGE

Floats = NDArray[np.float64]

CELLS = 8  #: minimum number of cells for an estimate of their scatter
_NORMAL = 1.4826  #: standard deviation / median distance from the mean of a normal law


@dataclass(frozen=True, kw_only=True)
class Slower:
    """A solver, or one of its cells, that became slower."""

    solver: str
    case: str = ""  #: empty for a solver over its cases
    tol: float | None = None
    ratio: Ratio  #: ratio of times, after / before; interval corrected for multiplicity
    relative: Ratio  #: `ratio` divided by the ratio of the other solvers, by blocks


@dataclass(frozen=True, kw_only=True)
class Regressions:
    """Slowdowns, and the number of statistical tests from which they result."""

    slower: tuple[Slower, ...]
    solvers: int  #: number of solvers judged over their cases
    cells: int  #: number of cells judged individually
    why_not: str = ""  #: reason why nothing could be judged; empty otherwise
    unverified: tuple[str, ...] = ()  #: solvers without a verified answer in one folder


class _Change(NamedTuple):
    """Logarithms of the times of one cell, absolute and relative to other solvers."""

    outcome: Outcome
    own: tuple[Floats, Floats]  #: logarithms after and before
    relative: tuple[Floats, Floats]


def regressions(c: Comparison) -> Regressions:
    """Find the solvers and cells that became slower from one folder to the other.

    If several folders are compared with the same earlier folder, the confidence level
    applies jointly to the intervals of all comparisons.
    """
    changes = _changes(c)
    by_solver = grouped(changes, lambda change: change.outcome.solver)
    cases = {s: grouped(of, lambda x: x.outcome.case) for s, of in by_solver.items()}
    judged = {s: of.values() for s, of in cases.items() if len(of) >= FEWEST}
    cells = changes if len(changes) >= CELLS else []
    if not judged and not cells:
        why = f"no solver has {FEWEST} cases, and there are fewer than {CELLS} cells"
        why = why if changes else _why_not(c)
        return Regressions(slower=(), solvers=0, cells=0, why_not=why)
    miss = (1 - COVERAGE) / 2 / c.folders
    found = [_of_solver(s, of, miss / len(judged)) for s, of in judged.items()]
    if cells:
        scatter = _NORMAL * float(
            np.median(
                [
                    abs(mean - float(np.median(means)))
                    for of in by_solver.values()
                    for means in [[_mean(change.relative) for change in of]]
                    for mean in means
                ]
            )
        )
        freedom = max(len(cells) - len(by_solver), 1)
        found += [_of_cell(x, scatter, freedom, miss / len(cells)) for x in cells]
    return Regressions(
        slower=tuple(x for x in found if min(x.ratio.low, x.relative.low) > 1),
        solvers=len(judged),
        cells=len(cells),
        unverified=_unverified(c, folders=1),
    )


def _unverified(c: Comparison, folders: int) -> tuple[str, ...]:
    """Describe the solvers without a verified answer, in one folder or in both.

    folders : number of folders without a verified answer, 1 or 2
    """
    found = []
    for solver in c.solvers:
        pairs = [p for p in c.of(solver) if not p.after.first.arm]
        lacking = [
            str(evidence.directory)
            for evidence, outcomes in (
                (c.before, [p.before for p in pairs]),
                (c.after, [p.after for p in pairs]),
            )
            if not any(r.status.is_verified for o in outcomes for r in o.records)
        ]
        if pairs and len(lacking) == folders:
            where = " and in ".join(lacking)
            found.append(
                f"{solver} has no verified answer in {where}: nothing to compare"
            )
    return tuple(found)


def _why_not(c: Comparison) -> str:
    if not any(p.same_machine for p in c.pairs):
        return "no cell was measured on equal machines in both folders"
    if not any(p.same_problem for p in c.pairs):
        return "no cell has the same QP in both folders"
    if lacking := _unverified(c, folders=1):
        return "; ".join(lacking)
    if not c.timed:
        return "no cell has two verified repeats in both folders"
    if lacking := _unverified(c, folders=2):
        return "; ".join(lacking)
    return (
        "no two solvers of both folders were measured in the same blocks, and the "
        "change of a lone solver may be due to the machine; add a solver that does not "
        "change"
    )


def _changes(c: Comparison) -> list[_Change]:
    """Return the changes of cells that have times and other solvers in both folders."""
    timed = [p for p in c.timed if not p.after.first.arm]
    rows = grouped(timed, lambda p: (*block_of(p), p.after.first.mode))
    found = []
    for row in rows.values():
        for p in row:
            others = [o for o in row if o is not p]
            relative = (
                _relative(p.after, [o.after for o in others]),
                _relative(p.before, [o.before for o in others]),
            )
            if min(map(len, relative)) > 1:
                own = _logs(p.after), _logs(p.before)
                found.append(_Change(p.after, own, relative))
    return found


def _logs(outcome: Outcome) -> Floats:
    return np.log([*outcome.by_block.values()])


def _relative(own: Outcome, others: Sequence[Outcome]) -> Floats:
    """Return, by block, log(time / geometric mean of the other times)."""
    times = [o.by_block for o in others]
    return np.array(
        [
            np.log(seconds) - np.mean([np.log(of[block]) for of in times])
            for block, seconds in own.by_block.items()
            if times and all(block in of for of in times)
        ]
    )


def _mean(logs: tuple[Floats, Floats]) -> float:
    """Return the mean logarithm after minus the mean logarithm before."""
    return float(np.mean(logs[0]) - np.mean(logs[1]))


def _of_solver(
    solver: str, cases: Collection[Sequence[_Change]], miss: float
) -> Slower:
    """Average logarithms of ratios over cases, with Student's interval.

    miss : probability that the mean is outside the interval
    """

    def student(x: Floats) -> Ratio:
        half = stdtrit(x.size - 1, 1 - miss / 2) * x.std(ddof=1) / np.sqrt(x.size)
        return _ratio(float(x.mean()), float(half), x.size)

    own = np.array([np.mean([_mean(x.own) for x in of]) for of in cases])
    relative = np.array([np.mean([_mean(x.relative) for x in of]) for of in cases])
    return Slower(solver=solver, ratio=student(own), relative=student(relative))


def _of_cell(change: _Change, scatter: float, freedom: int, miss: float) -> Slower:
    after, before = map(np.exp, change.own)
    own = unpaired_ratio(after, before, 1 - miss)
    assert own is not None  # both samples have at least two repeats
    variances = (np.var(x, ddof=1) / len(x) for x in change.relative)
    error = max(scatter, float(np.sqrt(sum(variances))))
    half = float(stdtrit(freedom, 1 - miss / 2)) * error
    repeats = min(map(len, change.relative))
    relative = _ratio(_mean(change.relative), half, repeats)
    o = change.outcome
    return Slower(solver=o.solver, case=o.case, tol=o.tol, ratio=own, relative=relative)


def _ratio(log: float, half: float, of: int) -> Ratio:
    low, value, high = np.exp(log + np.array([-half, 0.0, half]))
    return Ratio(float(value), float(low), float(high), of, paired=False)
