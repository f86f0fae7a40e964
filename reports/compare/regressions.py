"""Which solvers became slower, so surely that a CI may fail on it.

Two runs of the same code differ: the machine is faster or slower for a while, and not
alike on every case. What is said here therefore has two intervals, and both must lie
wholly above 1: that of the ratio itself, after over before, and that of the ratio
relative to the other solvers of the same blocks, in which what slows all of them down
cancels. Both are unpaired between the folders: they are different sessions.

- A solver: mean of the logarithms over its cases, Student's interval over them, three
  at least. How much a run differs from another one on a case is in that scatter.
- A single cell: an error that is the larger one of Welch's over its repeats and of what
  the cells scatter about the means of their solvers (1.4826 times the median distance,
  which is the standard deviation of a normal law). It takes `CELLS` cells to know that.

The intervals hold 95 % all together: half of the 5 % is for the solvers, half for the
cells, and each half is shared out evenly (Bonferroni) [1]_.

References
----------
.. [1] R. G. Miller, Simultaneous Statistical Inference, 2nd ed., 1981, §1.3, 2.1

"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from mortarbench.harness.running.pairs import Block, Ratio, unpaired_ratio
from mortarbench.reports.compare.changes import FEWEST, Comparison, Pair
from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.statistics.intervals import COVERAGE

CELLS = 8  #: that it takes to know how much they scatter
_NORMAL = 1.4826  #: standard deviation of a normal law over its median distance


@dataclass(frozen=True, kw_only=True)
class Slower:
    """A solver, or one cell of it, that takes longer after than before."""

    solver: str
    case: str = ""  #: empty: over its cases
    tol: float | None = None
    ratio: Ratio  #: of times, after over before; the interval is corrected
    relative: Ratio  #: the same over that of the other solvers of its blocks


@dataclass(frozen=True, kw_only=True)
class Regressions:
    """What became slower, and how much was asked."""

    slower: tuple[Slower, ...]
    solvers: int  #: that could be judged over their cases
    cells: int  #: that could be judged one by one
    why_not: str = ""  #: why nothing could be judged
    unverified: tuple[str, ...] = ()  #: solvers without a verified answer in one folder


@dataclass(frozen=True, eq=False, kw_only=True)
class _Change:
    """Logarithms of the times of one cell, and the same relative to other solvers."""

    pair: Pair
    before: tuple[float, ...]
    after: tuple[float, ...]
    relative_before: tuple[float, ...]
    relative_after: tuple[float, ...]

    @property
    def own(self) -> float:
        return float(np.mean(self.after) - np.mean(self.before))

    @property
    def relative(self) -> float:
        return float(np.mean(self.relative_after) - np.mean(self.relative_before))

    @property
    def error(self) -> float:
        """Standard error of `relative`, of the repeats alone."""
        sides = (self.relative_after, self.relative_before)
        return float(np.sqrt(sum(np.var(x, ddof=1) / len(x) for x in sides)))


def regressions(c: Comparison) -> Regressions:
    """Find what became slower from one folder to another.

    Where several folders are compared with one, the intervals of all hold together.
    """
    changes = _changes(c)
    if not changes:
        return Regressions(slower=(), solvers=0, cells=0, why_not=_why_not(c))
    by_solver: dict[str, list[_Change]] = {}
    for change in changes:
        by_solver.setdefault(change.pair.after.solver, []).append(change)
    judged = {s: own for s, own in by_solver.items() if len(_by_case(own)) >= FEWEST}
    cells = changes if len(changes) >= CELLS else []
    if not judged and not cells:
        why = f"fewer than {FEWEST} cases of a solver, and of {CELLS} cells in all"
        return Regressions(slower=(), solvers=0, cells=0, why_not=why)
    miss = (1 - COVERAGE) / 2 / c.folders
    found = [
        one
        for solver, own in judged.items()
        if (one := _of_solver(solver, own, miss / len(judged))) is not None
    ]
    if cells:
        scatter = _scatter(by_solver.values())
        freedom = max(len(cells) - len(by_solver), 1)
        found += [
            one
            for change in cells
            if (one := _of_cell(change, scatter, freedom, miss / len(cells)))
        ]
    return Regressions(
        slower=tuple(found),
        solvers=len(judged),
        cells=len(cells),
        unverified=_unverified(c, folders=1),
    )


def _unverified(c: Comparison, folders: int) -> tuple[str, ...]:
    """Name the solvers that have no verified answer in so many of the two folders."""
    found = []
    for solver in c.solvers:
        pairs = [p for p in c.of(solver) if not p.after.first.role]
        lacking = [
            str(evidence.directory)
            for evidence, outcomes in (
                (c.before, [p.before for p in pairs]),
                (c.after, [p.after for p in pairs]),
            )
            if not any(r.verdict.is_verified for o in outcomes for r in o.records)
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
    if lacking := _unverified(c, folders=1):
        return "; ".join(lacking)
    if not c.timed:
        return "no cell has two verified repeats in both folders"
    if lacking := _unverified(c, folders=2):
        return "; ".join(lacking)
    return (
        "no two solvers of both folders were measured in the same blocks, and one "
        "alone is not told from the machine; add one that does not change"
    )


def _changes(c: Comparison) -> list[_Change]:
    """Take the cells that have times in both folders, and other solvers beside them."""
    rows: dict[tuple[str, float, str], list[Pair]] = {}
    for p in c.pairs:
        if p.ratio is not None and not p.after.first.role:
            key = (p.after.case, p.after.tol, p.after.first.mode)
            rows.setdefault(key, []).append(p)
    found = [
        _change(p, [o for o in row if o is not p]) for row in rows.values() for p in row
    ]
    return [change for change in found if change is not None]


def _change(p: Pair, others: Sequence[Pair]) -> _Change | None:
    before = _relative(p.before, [o.before for o in others])
    after = _relative(p.after, [o.after for o in others])
    if min(len(before), len(after)) < 2:
        return None
    own = [tuple(np.log([*o.by_block.values()])) for o in (p.before, p.after)]
    return _Change(
        pair=p, before=own[0], after=own[1],
        relative_before=before, relative_after=after,
    )  # fmt: skip


def _relative(own: Outcome, others: Sequence[Outcome]) -> tuple[float, ...]:
    """Logarithms of time over the geometric mean of the others, block by block."""
    times: list[Mapping[Block, float]] = [o.by_block for o in others]
    return tuple(
        float(np.log(seconds) - np.mean([np.log(of[block]) for of in times]))
        for block, seconds in own.by_block.items()
        if times and all(block in of for of in times)
    )


def _by_case(changes: Sequence[_Change]) -> dict[str, list[_Change]]:
    cases: dict[str, list[_Change]] = {}
    for change in changes:
        cases.setdefault(change.pair.after.case, []).append(change)
    return cases


def _of_solver(solver: str, changes: Sequence[_Change], miss: float) -> Slower | None:
    cases = _by_case(changes).values()
    own = _student([float(np.mean([c.own for c in of])) for of in cases], miss)
    relative = _student(
        [float(np.mean([c.relative for c in of])) for of in cases], miss
    )
    if min(own.low, relative.low) <= 1:
        return None
    return Slower(solver=solver, ratio=own, relative=relative)


def _student(logs: Sequence[float], miss: float) -> Ratio:
    """Average logarithms of ratios over cases.

    miss : probability that the interval does not hold the mean, on either side
    """
    x = np.asarray(logs)
    half = stdtrit(x.size - 1, 1 - miss / 2) * x.std(ddof=1) / np.sqrt(x.size)
    return _ratio(float(x.mean()), float(half), x.size)


def _of_cell(
    change: _Change, scatter: float, freedom: int, miss: float
) -> Slower | None:
    own = unpaired_ratio(np.exp(change.after), np.exp(change.before), 1 - miss)
    assert own is not None  # there are two repeats of each
    error = max(scatter, change.error)
    repeats = min(len(change.relative_after), len(change.relative_before))
    half = float(stdtrit(freedom, 1 - miss / 2)) * error
    relative = _ratio(change.relative, half, repeats)
    if min(own.low, relative.low) <= 1:
        return None
    o = change.pair.after
    return Slower(
        solver=o.solver, case=o.case, tol=o.tol, ratio=own, relative=relative
    )  # fmt: skip


def _scatter(solvers: Iterable[Sequence[_Change]]) -> float:
    """Estimate how much the changes of cells scatter about those of their solvers."""
    distances = [
        abs(change.relative - float(np.median([c.relative for c in own])))
        for own in solvers
        for change in own
    ]
    return _NORMAL * float(np.median(distances))


def _ratio(log: float, half: float, of: int) -> Ratio:
    low, value, high = np.exp(log + np.array([-half, 0.0, half]))
    return Ratio(float(value), float(low), float(high), of, paired=False)
