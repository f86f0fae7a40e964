"""How fast the ranks of a solve talk to one another: latencies and bandwidth."""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from mpi4py.MPI import Comm

LARGE = 2**20  #: bytes of a message that only bandwidth matters to
_BATCHES = 5  #: of calls that are timed together, the first included


def network(comm: Comm) -> dict[str, float]:
    """Time reductions and messages; called by all ranks, takes some milliseconds.

    Messages go round a ring, all ranks sending at the same time, as neighbours do in a
    product. Medians of batches.

    Returns
    -------
    reduction_seconds : of one number over all ranks, s
    message_seconds : of eight bytes to a neighbour, s
    seconds_per_byte : of long messages to a neighbour, s

    """
    right, left = (comm.rank + 1) % comm.size, (comm.rank - 1) % comm.size
    one, all_ = np.zeros(1), np.zeros(comm.size)
    sent, received = np.zeros(LARGE // 8), np.zeros(LARGE // 8)

    def reduction() -> None:
        comm.Allgather(one, all_)

    def message(size: int) -> None:
        comm.Sendrecv(sent[:size], right, recvbuf=received[:size], source=left)

    short = _seconds(lambda: message(1), 10)
    long = _seconds(lambda: message(sent.size), 2)
    return {
        "reduction_seconds": _seconds(reduction, 10),
        "message_seconds": short,
        "seconds_per_byte": max(long - short, 0.0) / LARGE,
    }


def _seconds(act: Callable[[], None], times: int) -> float:
    """Take the median over batches of the time of one act, s; the first warms up."""
    found = []
    for _ in range(_BATCHES):
        start = perf_counter()
        for _ in range(times):
            act()
        found.append((perf_counter() - start) / times)
    return median(found[1:])
