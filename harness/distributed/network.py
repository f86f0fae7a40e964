"""Latency and bandwidth of the messages between the ranks of a solve."""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from mpi4py.MPI import Comm

#: size in bytes of a message, so large that its time depends mainly on the bandwidth
LARGE_BYTES = 2**20
#: number of batches of timed calls; the first batch is discarded as warm-up
_BATCHES = 5


def network(comm: Comm) -> dict[str, float]:
    """Measure the times of reductions and messages; called by all ranks.

    The ranks form a ring, and all ranks send to the next rank simultaneously, as in a
    matrix-vector product. Times are medians over batches. The measurement takes a few
    milliseconds.

    Returns
    -------
    reduction_seconds : time to reduce one number over all ranks, s
    message_seconds : time to send eight bytes to the next rank, s
    seconds_per_byte : time per byte of a long message to the next rank, s

    """
    right, left = (comm.rank + 1) % comm.size, (comm.rank - 1) % comm.size
    one, all_ = np.zeros(1), np.zeros(comm.size)
    sent, received = np.zeros(LARGE_BYTES // 8), np.zeros(LARGE_BYTES // 8)

    def reduction() -> None:
        comm.Allgather(one, all_)

    def message(size: int) -> None:
        comm.Sendrecv(sent[:size], right, recvbuf=received[:size], source=left)

    short = _seconds(lambda: message(1), 10)
    long = _seconds(lambda: message(sent.size), 2)
    return {
        "reduction_seconds": _seconds(reduction, 10),
        "message_seconds": short,
        "seconds_per_byte": max(long - short, 0.0) / LARGE_BYTES,
    }


def _seconds(call: Callable[[], None], times: int) -> float:
    """Return the time of a call in s, as the median over batches of `times` calls."""
    seconds = []
    for _ in range(_BATCHES):
        start = perf_counter()
        for _ in range(times):
            call()
        seconds.append((perf_counter() - start) / times)
    return median(seconds[1:])
