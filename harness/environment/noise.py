"""Noise floor of a machine, determined by an A/A comparison.

The two times of a pair are measured with the same kernel in immediate succession, like
the times of solvers within a block. A difference between two solvers is not significant
if it is smaller than the differences within such pairs.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import exp

import numpy as np
from scipy.sparse import csr_array, diags_array, eye_array, kron

from mortarbench.harness.environment.cpus import fastest_first

_SIDE = 120  #: number of nodes per side of a square grid, whose matrix has 14 400 rows
#: number of matrix-vector products in a timed call, which takes about 1 ms
_PRODUCTS = 10
_BLOCKS = 20  #: number of blocks of consecutive pairs in the bootstrap
_DRAWS = 1000  #: number of bootstrap samples


@dataclass(frozen=True, kw_only=True)
class NoiseFloor:
    """Result of an A/A comparison, in which arms A and B run the same kernel."""

    clock_seconds: float  #: smallest observed step of the clock
    kernel_seconds: float  #: median time of the kernel
    pairs: int  #: number of pairs of times
    ratio: float  #: median ratio of the time of arm A to the time of arm B
    low: float  #: lower end of the 95 % bootstrap interval of `ratio`
    high: float  #: upper end of the 95 % bootstrap interval of `ratio`
    one_pair: float  #: relative difference that 95 % of single pairs do not exceed


def noise_floor(
    seconds: float = 2.0, clock: Callable[[], float] = time.perf_counter
) -> NoiseFloor:
    """Compare repeated times of one kernel, on the CPU to which workers are bound.

    Pairs are measured in the order AB, BA, AB, …, and the log ratios of two successive
    pairs are averaged, so that a linear drift of the machine cancels. The bootstrap
    resamples blocks of consecutive pairs instead of single pairs, since disturbances
    last longer than one pair.

    seconds : duration of the comparison, measured with `clock`
    clock : function that returns the time in s
    """
    with _on_the_workers_cpu():
        one = diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(_SIDE, _SIDE))
        K = csr_array(kron(one, eye_array(_SIDE)) + kron(eye_array(_SIDE), one))

        def timed() -> float:
            v = np.ones(K.shape[0])
            start = clock()
            for _ in range(_PRODUCTS):
                v = K @ v
                v /= np.abs(v).max()
            return clock() - start

        timed()  # discard the first time, for which caches are cold
        arms: tuple[list[float], list[float]] = ([], [])
        end = clock() + seconds
        while clock() < end or not arms[0]:
            for first in (0, 1):
                arms[first].append(timed())
                arms[1 - first].append(timed())
        a, b = np.array(arms[0]), np.array(arms[1])
    singles = np.log(a / b)
    balanced = singles.reshape(-1, 2).mean(axis=1)
    blocks = np.array_split(balanced, min(_BLOCKS, balanced.size))
    rng = np.random.default_rng(20260)
    drawn = rng.integers(len(blocks), size=(_DRAWS, len(blocks)))
    medians = [np.median(np.concatenate([blocks[i] for i in row])) for row in drawn]
    low, high = np.quantile(medians, (0.025, 0.975))
    return NoiseFloor(
        clock_seconds=_clock_step(clock),
        kernel_seconds=float(np.median(np.concatenate((a, b)))),
        pairs=a.size,
        ratio=exp(np.median(balanced)),
        low=exp(low),
        high=exp(high),
        one_pair=exp(np.quantile(np.abs(singles), 0.95)) - 1,
    )


@contextmanager
def _on_the_workers_cpu() -> Iterator[None]:
    """Run the block on the fastest usable CPU, to which workers are bound."""
    usable = os.sched_getaffinity(0)
    os.sched_setaffinity(0, fastest_first(usable)[:1])
    try:
        yield
    finally:
        os.sched_setaffinity(0, usable)


def _clock_step(clock: Callable[[], float], tries: int = 1000) -> float:
    """Return the smallest nonzero difference of consecutive readings of a clock."""
    readings = np.array([clock() for _ in range(tries)])
    steps = np.diff(readings)
    return float(steps[steps > 0].min(initial=np.inf))
