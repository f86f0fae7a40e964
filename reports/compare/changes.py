"""Changes between two result folders, for each cell and each solver.

A cell is one solver in one mode on one case at one tolerance. Its times before and
after are two unpaired samples, because the folders are different sessions. Times are
divided only if they were measured on one machine, on one problem.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple
from zlib import crc32

import numpy as np
from scipy.special import ndtri, stdtrit

from mortarbench.harness.running.pairs import Ratio, unpaired_ratio
from mortarbench.reports.compare.conditions import hardware
from mortarbench.reports.data.environment import by_environment
from mortarbench.reports.data.evidence import FROM_FILE, SEVERITY, Evidence, Outcome
from mortarbench.reports.document.grouping import grouped
from mortarbench.reports.statistics.intervals import COVERAGE

DRAWS = 2000  #: number of bootstrap resamples; 50 of them form a tail of 2.5 %
ALIKE = 1.5  #: intervals around 1 within (1/ALIKE, ALIKE) mean "no change seen"
FEWEST = 3  #: minimum number of cells for an interval over cells
_NEGLIGIBLE = 1e-12  #: smaller absolute differences of energies count as rounding

#: case (for a QP from a file, its digest), tolerance, and solver with its mode
Key = tuple[str, float, str]


@dataclass(frozen=True, eq=False, kw_only=True)
class Pair:
    """Outcomes of one cell before and after."""

    before: Outcome
    after: Outcome
    same_machine: bool  #: True if the times may be compared

    @property
    def same_sizes(self) -> bool:
        """True if the QPs have equal numbers of variables and constraints."""
        return self.before.first.sizes == self.after.first.sizes

    @property
    def same_qp(self) -> bool:
        """True if the QPs are bitwise equal, as far as the journals record digests."""
        digests = {r.qp for o in (self.before, self.after) for r in o.records}
        return self.same_sizes and len(digests - {None}) < 2

    @property
    def same_problem(self) -> bool:
        """True if the QPs differ at most by rounding errors.

        QPs with different digests, as with another version of BLAS, count as one
        problem if their parameters and sizes are equal, and if their verified answers
        have equal energies.
        """
        same_params = self.before.first.params == self.after.first.params
        return self.same_qp or (
            same_params and self.same_sizes and not self.other_answer
        )

    @property
    def both_verified(self) -> bool:
        """True if both answers are verified and the QPs have equal sizes."""
        return self.before.verified and self.after.verified and self.same_sizes

    @cached_property
    def log(self) -> float | None:
        """Mean logarithm of the times after, minus the mean logarithm before.

        None if the times cannot be compared.
        """
        a, b = _seconds(self.after), _seconds(self.before)
        comparable = self.both_verified and self.same_machine and self.same_problem
        if not (comparable and a and b):
            return None
        return float(np.mean(np.log(a)) - np.mean(np.log(b)))

    @cached_property
    def ratio(self) -> Ratio | None:
        """Time after / time before with Welch's interval.

        None if the times cannot be compared, or one sample has fewer than two times.
        """
        # A bootstrap over three to ten repeats would report a spurious change three to
        # five times as often as at the nominal rate of one in twenty.
        if self.log is None:
            return None
        return unpaired_ratio(_seconds(self.after), _seconds(self.before))

    @property
    def change(self) -> int:
        """1 if slower, -1 if faster, 0 if the interval contains 1 or is missing."""
        return side(self.ratio)

    @property
    def turn(self) -> int:
        """1 if the verdict became worse, -1 if it became better, 0 if unchanged."""
        a, b = (SEVERITY.index(o.verdict) for o in (self.after, self.before))
        return (a < b) - (a > b)

    @property
    def other_iterations(self) -> bool:
        """True if the ranges of iterations before and after do not overlap."""
        a, b = self.before.iterations, self.after.iterations
        return a is not None and b is not None and (a[1] < b[0] or b[1] < a[0])

    @cached_property
    def answers(self) -> tuple[float, float, float] | None:
        """Energy (or the objective) before and after, and their relative difference.

        The difference is relative to the larger absolute value. None if an answer is
        not verified or has no such value.
        """
        pairs = (
            (self.before.energy, self.after.energy),
            (self.before.first.objective, self.after.first.objective),
        )
        known = [(a, b) for a, b in pairs if a is not None and b is not None]
        if not (known and self.both_verified):
            return None
        a, b = known[0]
        apart, size = abs(a - b), max(abs(a), abs(b))
        return a, b, 0.0 if apart <= _NEGLIGIBLE else apart / size

    @property
    def may_differ(self) -> float:
        """Largest relative difference that two verified energies may have."""
        # A gap is relative to the largest energy term, about twice the potential
        # energy; hence the factor 2 on the sum of both tolerances.
        return 2 * (self.before.allowed + self.after.allowed)

    @property
    def other_answer(self) -> bool:
        """True if verified answers differ by more than their gaps allow."""
        return self.answers is not None and self.answers[2] > self.may_differ


class Mean(NamedTuple):
    """Geometric mean of ratios over cells, with an interval that may be unbounded."""

    value: float
    low: float
    high: float
    cells: int


@dataclass(frozen=True, eq=False, kw_only=True)
class Comparison:
    """Two result folders and their common cells."""

    before: Evidence
    after: Evidence
    pairs: tuple[Pair, ...]
    only_before: tuple[Outcome, ...]
    only_after: tuple[Outcome, ...]
    folders: int = 1  #: number of folders compared with `before`, including `after`

    @property
    def worse(self) -> tuple[Pair, ...]:
        """Pairs whose verdict became worse."""
        return tuple(p for p in self.pairs if p.turn > 0)

    @property
    def solvers(self) -> tuple[str, ...]:
        """Labels of the solvers in both folders, in the order of the later folder."""
        present = {p.after.solver for p in self.pairs}
        return tuple(s for s in self.after.solvers if s in present)

    @property
    def timed(self) -> tuple[Pair, ...]:
        """Pairs whose ratio of times has an interval."""
        return tuple(p for p in self.pairs if p.ratio is not None)

    def of(self, solver: str) -> tuple[Pair, ...]:
        """Return all pairs of one solver."""
        return tuple(p for p in self.pairs if p.after.solver == solver)


def compare(before: Evidence, after: Evidence, folders: int = 1) -> Comparison:
    """Pair the cells of two folders, in the order of the later folder.

    If a folder contains several environments, outcomes of one machine are paired first.

    folders : number of folders compared with `before`, including `after`
    """
    machines = hardware(before) | hardware(after)
    left, pairs, only_after = _cells(before), list[Pair](), list[Outcome]()
    for key, outcomes in _cells(after).items():
        for on_one_machine in (True, False):
            for o in [*outcomes]:
                here = machines[o.first.environment]
                for other in left.get(key, ()):
                    same = here == machines[other.first.environment]
                    if same or not on_one_machine:
                        pairs.append(Pair(before=other, after=o, same_machine=same))
                        left[key].remove(other)
                        outcomes.remove(o)
                        break
        only_after += outcomes
    return Comparison(
        before=before,
        after=after,
        pairs=tuple(pairs),
        only_before=tuple(o for outcomes in left.values() for o in outcomes),
        only_after=tuple(only_after),
        folders=folders,
    )


def _cells(evidence: Evidence) -> dict[Key, list[Outcome]]:
    """Return the outcomes of every cell, one for each environment."""
    parts = by_environment(evidence)
    return grouped((o for part in parts for o in part.flat), _key)


def mean_ratio(pairs: Sequence[Pair]) -> Mean | None:
    """Return the mean ratio of times over cells (see `mean_of`); None without times."""
    return _over_cells((p, p.log) for p in pairs)


def relative_ratio(c: Comparison, solver: str) -> Mean | None:
    """Average the ratios of a solver relative to the ratios of the other solvers.

    For each case and tolerance, the ratio of the solver is divided by the geometric
    mean of the other ratios, which cancels a slowdown of the whole run. Return
    None if no other solver has times.
    """
    competing = (p for p in c.pairs if p.after.solver != solver)
    rivals = grouped((p for p in competing if not p.after.first.arm), block_of)
    changes = []
    for p in c.of(solver):
        others = rivals.get(block_of(p), ())
        logs = [other.log for other in others if other.log is not None]
        if p.log is not None and logs:
            changes.append((p, p.log - float(np.mean(logs))))
    return _over_cells(changes)


def block_of(p: Pair) -> tuple[str, float, str]:
    """Return case, tolerance and environment, which the solvers of a block share."""
    return p.after.case, p.after.tol, p.after.first.environment


def _over_cells(changes: Iterable[tuple[Pair, float | None]]) -> Mean | None:
    known = [(log, str(_key(p.after))) for p, log in changes if log is not None]
    return mean_of([log for log, _ in known], [name for _, name in known])


def mean_of(logs: Sequence[float], names: Sequence[str]) -> Mean | None:
    """Average logarithms of ratios over cells, with a bootstrap interval over cells.

    A cell is resampled as a whole, with its times before and after. Percentile
    intervals of n values are too narrow for two reasons: resamples scatter too little,
    by the factor √((n−1)/n), and their tails are normal instead of Student's. The
    distances of the ends from the mean are increased to correct both effects [1]_. The
    names of the cells seed the generator. For fewer than three cells the interval is
    unbounded.

    References
    ----------
    .. [1] T. C. Hesterberg, What Teachers Should Know About the Bootstrap, The American
       Statistician 69 (2015) 371-386, §4.2

    """
    n = len(logs)
    if not n:
        return None
    x = np.asarray(logs)
    mean = float(x.mean())
    if n < FEWEST:
        return Mean(float(np.exp(mean)), 0.0, np.inf, n)
    rng = np.random.default_rng(crc32("\n".join(names).encode()))
    draws = x[rng.integers(0, n, (DRAWS, n))].mean(axis=1)
    quantile = 0.5 + COVERAGE / 2
    wider = np.sqrt(n / (n - 1)) * stdtrit(n - 1, quantile) / ndtri(quantile)
    low, high = np.quantile(draws, (1 - quantile, quantile)) - mean
    value, low, high = np.exp(mean + wider * np.array([0.0, low, high]))
    return Mean(float(value), float(low), float(high), n)


def side(interval: Ratio | Mean | None) -> int:
    """Return 1 if slower, -1 if faster, 0 if the interval contains 1 or is missing."""
    if interval is None:
        return 0
    return int(interval.low > 1) - int(interval.high < 1)


def resolved(interval: Ratio | Mean) -> bool:
    """Return whether a change is visible, or one by `ALIKE` or 1/`ALIKE` would be."""
    return side(interval) != 0 or 1 / ALIKE < interval.low <= interval.high < ALIKE


def _key(outcome: Outcome) -> Key:
    r = outcome.first
    case = r.qp if r.family == FROM_FILE and r.qp is not None else outcome.case
    return case, outcome.tol, outcome.solver


def _seconds(outcome: Outcome) -> list[float]:
    return [*outcome.by_block.values()]
