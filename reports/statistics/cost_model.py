"""A model of the time of a solve on N ranks: shared and repeated work, messages.

    t(N) = s(N)·(W/N + C) + R·α_R(N) + M(N)·α + b·β

W is the work that the ranks share, in seconds of one rank. C is the time in which each
rank repeats work or waits for others (Amdahl [1]_). s is the slowdown of a rank while
the other ranks are busy: the time of simultaneous copies of the job, one per rank,
divided by the time of a single job. A rank of a shared job uses less memory than a copy
and may disturb the other ranks less; therefore s is limited to the largest value that
leaves C ≥ 0, or to 1 if this value is smaller. The other terms are communication [2]_:
R reductions over all ranks, and M messages with b bytes in total to neighbouring ranks.
A reduction has the latency α_R, a message has the latency α, and a byte takes β
seconds.

W and C are fitted to measured times; s, α_R, α and β are measured; R, M and b are
counted. All of this is done on the ranks of the run. Superlinear speed-up cannot be
fitted even with s = 1; it increases the misfit. Beyond the measured ranks, the model is
extended as follows:

- s is constant, because further ranks are assumed to bring their own memory;
- α_R is proportional to ⌈log₂N⌉, the depth of a tree of ranks;
- M is proportional to the number of neighbours of a rank, N − 1 but at most six, since
  a planar graph has fewer than three edges per vertex (Euler);
- b is constant: each half of a square touches the other half along one side, and an
  inner sixteenth of the square touches its neighbours along four quarters of a side.

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

NEIGHBOURS = 6  #: upper bound on the average degree of a planar graph (Euler)
MAX_RANKS = 2**20  #: `CostModel.ranks_at` tries numbers of ranks below this value

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Communication:
    """Communication of a rank in one solve on `ranks` ranks, and its unit costs."""

    ranks: int  #: number of ranks, at least two
    reductions: float  #: number of reductions over all ranks
    messages: float  #: number of messages to neighbouring ranks
    sent: float  #: number of bytes in these messages
    reduction_seconds: float  #: time to reduce one number over all ranks
    message_seconds: float  #: time of the shortest message
    seconds_per_byte: float

    @property
    def seconds(self) -> Array:
        """Time of reductions, messages and bytes on these ranks, s, (3,)."""
        return np.array(
            [
                self.reductions * self.reduction_seconds,
                self.messages * self.message_seconds,
                self.sent * self.seconds_per_byte,
            ]
        )


def growth(ranks: ArrayLike, measured: int) -> Array:
    """Return the growth (…, 3) of communication times relative to `measured` ranks.

    The last axis contains the factors of reductions, messages and bytes.
    """
    N = np.asarray(ranks, dtype=float)
    depth = np.ceil(np.log2(N)) / np.ceil(np.log2(measured))
    neighbours = np.minimum(N - 1, NEIGHBOURS) / min(measured - 1, NEIGHBOURS)
    return np.stack([depth, neighbours, 1.0 * (N > 1)], axis=-1)


@dataclass(frozen=True, kw_only=True)
class CostModel:
    """Cost model of one solve, with bootstrap draws for the scatter of the repeats."""

    work: float  #: shared work W, s
    repeated: float  #: repeated work C, s
    slowdown: float  #: slowdown s on the largest measured number of ranks
    #: time of reductions, messages and bytes on the largest measured number of ranks, s
    communication: tuple[float, float, float]
    measured: tuple[int, ...]  #: measured numbers of ranks, ascending
    misfit: float  #: largest |t/t_measured − 1| of the modelled times t
    #: (draws, 6) W, C, slowdown and communication of every draw; empty if the job on
    #: some number of ranks, or some number of copies, was measured only once
    draws: Array
    samples: int  #: smallest number of repeats

    def speed_up(self, ranks: int) -> Interval:
        """Predict t(1)/t(N) on more ranks than were measured, with its 95 % interval.

        The interval reflects the scatter of the repeats, not errors of the model.
        """
        value = float(self._speed_up(ranks, self._own)[0])
        if not len(self.draws):
            return Interval(value, value, value, COVERAGE, 1)
        low, high = limits(self._speed_up(ranks, self.draws), self.samples)
        return Interval(value, float(low), float(high), COVERAGE, self.samples)

    def ranks_at(self, efficiency: float) -> int:
        """Return the largest N = 2ᵏ such that 2, 4, …, N all reach `efficiency`."""
        N = 2
        while N < MAX_RANKS and self._speed_up(N, self._own)[0] >= efficiency * N:
            N *= 2
        return N // 2

    @property
    def _own(self) -> Array:
        return np.array(
            [[self.work, self.repeated, self.slowdown, *self.communication]]
        )

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

    Repeats are averaged by geometric means. Each draw resamples the repeats for each
    number of ranks, the repeats of the copies, and the communication.

    Parameters
    ----------
    seconds : times of all repeats by number of ranks; must contain one rank
    copies : times of simultaneous copies of the single-rank job, by number of copies;
        they give an upper bound on s; without copies, s = 1
    communication : one item per repeat on the largest number of ranks

    Raises
    ------
    ValueError
        If `seconds` does not contain one rank and a larger number of ranks, or if
        `communication` does not refer to the largest number of ranks.

    """
    ranks = sorted(seconds)
    if len(ranks) < 2 or ranks[0] != 1:
        raise ValueError("a cost model needs times on one rank and on several ranks")
    if not communication or {c.ranks for c in communication} != {ranks[-1]}:
        raise ValueError(f"a cost model needs the communication on {ranks[-1]} ranks")
    from scipy.optimize import nnls  # imported here: slow, and few reports need it

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
    # C ≥ 0 and W + C = t(1) imply W/N + C ≥ t(1)/N, hence s ≤ N·(t − sent)/t(1)
    bound = N * np.maximum(t - sent, 0.0) / t[:, :1]
    slow = np.where(slow > bound, np.maximum(bound, 1.0), slow)
    y, scale = np.maximum(t - sent, 0.0) / slow, t / slow
    terms = np.column_stack([1 / N, np.ones_like(N)])
    fits = [nnls(terms / s[:, None], v / s)[0] for v, s in zip(y, scale, strict=True)]
    work, repeated = np.transpose(fits)
    fitted = slow * (work[:, None] / N + repeated[:, None]) + sent
    return CostModel(
        work=float(work[0]),
        repeated=float(repeated[0]),
        slowdown=float(slow[0, -1]),
        communication=(float(parts[0, 0]), float(parts[0, 1]), float(parts[0, 2])),
        measured=tuple(ranks),
        misfit=float(np.abs(fitted[0] / t[0] - 1).max()),
        draws=np.column_stack([work, repeated, slow[:, -1], parts])[1:],
        samples=samples,
    )


def _geometric(values: ArrayLike, rng: np.random.Generator, count: int) -> Array:
    """Return geometric means (1 + count,) of the values and of `count` resamples."""
    with np.errstate(divide="ignore"):  # zero where nothing was sent
        logs = np.log(np.asarray(values, dtype=float))
    drawn = rng.integers(logs.size, size=(count, logs.size))
    return np.asarray(np.exp(np.r_[logs.mean(), logs[drawn].mean(axis=1)]))
