"""A model of the time of a solve on N ranks: shared and repeated work, messages.

    t(N) = s(N)·(W/N + C) + R·α_R(N) + M(N)·α + b·β

W is the work that ranks share, in seconds of one rank, and C what each of them does
alike or waits for (Amdahl [1]_). s says how much slower a rank works while the others
do, too: copies of the job on one rank, run together, over the job alone. A rank of a
shared job touches less memory than a copy, and may disturb the others less: so s is no
more than leaves C ≥ 0, and no less than 1. The rest is communication [2]_: R reductions
over all ranks, M messages and b bytes to neighbours, with the latencies α_R and α of a
reduction and of a message, and β seconds for a byte.

W and C are fitted to measured times, s and the latencies are measured, R, M and b are
counted, all on the ranks that there were. Ranks that are faster than their number even
with s = 1 are not fitted, and the misfit says so. Beyond the measured ranks, the model
goes on:

- s stays: further ranks bring memory of their own, as those measured do;
- α_R grows with ⌈log₂N⌉, the depth of a tree of ranks;
- M grows with the neighbours of a rank, N − 1 and at most six: a planar graph has fewer
  than three edges for each vertex (Euler);
- b stays: half of a square borders on the other half along one side of it, an inner
  sixteenth on its neighbours along four quarters of one.

References
----------
.. [1] G. M. Amdahl, Validity of the single processor approach to achieving large scale
   computing capabilities, AFIPS Conference Proceedings 30 (1967) 483-485
.. [2] R. W. Hockney, The communication challenge for MPP: Intel Paragon and Meiko CS-2,
   Parallel Computing 20 (1994) 389-398

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mortarbench.reports.statistics.intervals import COVERAGE, Interval
from mortarbench.reports.statistics.resampling import DRAWS, limits

NEIGHBOURS = 6  #: of a rank, at most, on the average of a planar graph
MOST_RANKS = 2**20  #: that an efficiency is looked for at

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Communication:
    """Messages of a rank in one solve on `ranks` ranks, and their speed."""

    ranks: int  #: at least two
    reductions: float  #: over all ranks
    messages: float  #: to neighbours
    sent: float  #: bytes
    reduction_seconds: float  #: of one number, over all ranks
    message_seconds: float  #: of the shortest
    seconds_per_byte: float

    @property
    def seconds(self) -> Array:
        """Seconds of reductions, messages and bytes on these ranks, (3,)."""
        return np.array(
            [
                self.reductions * self.reduction_seconds,
                self.messages * self.message_seconds,
                self.sent * self.seconds_per_byte,
            ]
        )


def growth(ranks: ArrayLike, measured: int) -> Array:
    """Return the factors by which the three grow on other ranks, (…, 3)."""
    N = np.asarray(ranks, dtype=float)
    depth = np.ceil(np.log2(N)) / np.ceil(np.log2(measured))
    neighbours = np.minimum(N - 1, NEIGHBOURS) / min(measured - 1, NEIGHBOURS)
    return np.stack([depth, neighbours, 1.0 * (N > 1)], axis=-1)


@dataclass(frozen=True, kw_only=True)
class CostModel:
    """The model of one solve, and other draws of it that the repeats allow for."""

    work: float  #: W, s
    alike: float  #: C, s
    slowdown: float  #: s on the most ranks measured
    #: s, of reductions, messages and bytes on the most ranks measured
    communication: tuple[float, float, float]
    measured: tuple[int, ...]  #: ranks, ascending
    misfit: float  #: largest |t/t_measured − 1|
    #: W, C, s and communication in every draw, (draws, 6); none where a number of ranks
    #: was measured once
    draws: Array
    samples: int  #: fewest repeats

    def speed_up(self, ranks: int) -> Interval:
        """Predict t(1)/t(N) on more ranks than were measured, with its 95 % interval.

        The interval is of the fit. It says nothing on whether the model holds there.
        """
        value = float(self._speed_up(ranks, self._own)[0])
        if not len(self.draws):
            return Interval(value, value, value, COVERAGE, 1)
        low, high = limits(self._speed_up(ranks, self.draws), self.samples)
        return Interval(value, float(low), float(high), COVERAGE, self.samples)

    def ranks_at(self, efficiency: float) -> int:
        """Find the most ranks, a power of two, whose speed-up is so many times N."""
        N = 2
        while N < MOST_RANKS and self._speed_up(N, self._own)[0] >= efficiency * N:
            N *= 2
        return N // 2

    @property
    def _own(self) -> Array:
        return np.array([[self.work, self.alike, self.slowdown, *self.communication]])

    def _seconds(self, ranks: int, draws: Array) -> Array:
        W, C, s = draws.T[:3]
        slow = s if ranks > 1 else 1.0
        sent = draws[:, 3:] @ growth(ranks, self.measured[-1])
        return np.asarray(slow * (W / ranks + C) + sent)

    def _speed_up(self, ranks: int, draws: Array) -> Array:
        return self._seconds(1, draws) / self._seconds(ranks, draws)


def cost_model(
    seconds: Mapping[int, Sequence[float]],
    copies: Mapping[int, Sequence[float]],
    communication: Sequence[Communication],
) -> CostModel:
    """Fit W and C ≥ 0 to the times of one solve by least squares of relative errors.

    Repeats are averaged by their logarithms. Draws resample the repeats of every number
    of ranks, those of the copies, and what was found of the network in each.

    Parameters
    ----------
    seconds : of every repeat, by ranks; one and others
    copies : of so many copies of the job on one rank, run together, likewise: no less
        than s; where there are none, s = 1
    communication : of every repeat on the most ranks

    Raises
    ------
    ValueError
        Without times on one rank and on several, or the communication on the most.

    """
    ranks = sorted(seconds)
    if len(ranks) < 2 or ranks[0] != 1:
        raise ValueError("a model of ranks needs times on one rank and on several")
    if not communication or {c.ranks for c in communication} != {ranks[-1]}:
        raise ValueError(f"a model needs what {ranks[-1]} ranks have sent")
    from scipy.optimize import nnls  # late: other reports begin without it

    N = np.array(ranks, dtype=float)
    samples = min(len(of) for of in (*seconds.values(), *copies.values()))
    rng = np.random.default_rng(crc32(repr(sorted(seconds.items())).encode()))
    count = DRAWS if samples > 1 else 0
    t = np.stack([_geometric(seconds[n], rng, count) for n in ranks], axis=1)
    slow = np.ones_like(t)
    for i, n in enumerate(ranks):
        if n > 1 and copies.get(n):
            slow[:, i] = _geometric(copies[n], rng, count) / t[:, 0]
    spent = np.stack([c.seconds for c in communication])
    parts = np.stack([_geometric(of, rng, count) for of in spent.T], axis=1)
    sent = parts @ growth(N, ranks[-1]).T
    with_none_alike = N * np.maximum(t - sent, 0.0) / t[:, :1]
    slow = np.where(slow > with_none_alike, np.maximum(with_none_alike, 1.0), slow)
    y, scale = np.maximum(t - sent, 0.0) / slow, t / slow
    terms = np.column_stack([1 / N, np.ones_like(N)])
    fits = [nnls(terms / s[:, None], v / s)[0] for v, s in zip(y, scale, strict=True)]
    work, alike = np.transpose(fits)
    found = slow * (work[:, None] / N + alike[:, None]) + sent
    return CostModel(
        work=float(work[0]),
        alike=float(alike[0]),
        slowdown=float(slow[0, -1]),
        communication=(float(parts[0, 0]), float(parts[0, 1]), float(parts[0, 2])),
        measured=tuple(ranks),
        misfit=float(np.abs(found[0] / t[0] - 1).max()),
        draws=np.column_stack([work, alike, slow[:, -1], parts])[1:],
        samples=samples,
    )


def _geometric(values: ArrayLike, rng: np.random.Generator, count: int) -> Array:
    """Average by logarithms: all values first, then `count` resamples of them."""
    with np.errstate(divide="ignore"):  # nothing may have been sent
        logs = np.log(np.asarray(values, dtype=float))
    drawn = rng.integers(logs.size, size=(count, logs.size))
    return np.asarray(np.exp(np.r_[logs.mean(), logs[drawn].mean(axis=1)]))
