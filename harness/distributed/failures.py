"""What one rank cannot do, all of them cannot: failures are agreed upon, or end all.

A rank that raises while others wait for its numbers would leave them waiting. So ranks
tell one another after each piece of work how it ended (`agreed`), through a
communicator that is used for nothing else. Who has failed waits a while for the others
to come there; if they do not, they wait elsewhere for what never comes, and only the
end of all processes ends that (`abort`).
"""

from __future__ import annotations

import json
import os
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from typing import NoReturn, TypeVar

import numpy as np

from mortarbench.harness.distributed.vectors import Ranks

T = TypeVar("T")

ALONE_SECONDS = 5.0  #: that a rank which failed waits for the others
#: environment variable with the file descriptor where `harness.processes.ranks.launch`
#: reads how ranks failed; what a solver prints is not looked at
RECORD = "MORTARBENCH_RANK_RECORD"
_PAUSE_SECONDS = 1e-3  #: between two looks whether they have come
_LONGEST = 500  #: bytes that are told of a failure


class RankFailedError(Exception):
    """A rank has failed; the message says which one, and how."""


def agreed(ranks: Ranks, work: Callable[[], T]) -> T:
    """Do a piece of work that all ranks do, and raise on all of them if any fails.

    Raises
    ------
    RankFailedError
        On every rank, when some have failed, or not all alike. What all raise alike
        comes through.

    """
    apart = ranks.apart  # all ranks are here, so that all can make it
    failure: Exception | None = None
    try:
        found = work()
    except Exception as e:
        failure = e
    own = np.zeros(_LONGEST, dtype=np.uint8)
    if failure is not None:
        text = in_a_line(failure).encode()[:_LONGEST]
        own[: len(text)] = np.frombuffer(text, dtype=np.uint8)
    everyones = np.empty((ranks.size, _LONGEST), dtype=np.uint8)
    told = apart.Iallgather(own, everyones)
    if failure is None:
        told.Wait()
    deadline = time.monotonic() + ALONE_SECONDS
    while failure is not None and not told.Test():
        if time.monotonic() > deadline:
            abort(ranks, failure)
        time.sleep(_PAUSE_SECONDS)
    failed = np.flatnonzero(everyones.any(axis=1))
    if not failed.size:
        return found
    if failure is not None and (everyones == own).all():
        raise failure
    first = bytes(everyones[failed[0]]).rstrip(b"\0").decode(errors="replace")
    raise RankFailedError(_named(int(failed[0]), ranks, first)) from failure


def abort(ranks: Ranks, failure: BaseException) -> NoReturn:
    """Record which rank failed and how, and end all ranks."""
    record(ranks.rank, _named(ranks.rank, ranks, in_a_line(failure)))
    with suppress(OSError, ValueError):  # a solver may have closed it
        traceback.print_exception(failure)
        sys.stderr.flush()
    ranks.comm.Abort(1)
    raise SystemExit(1)


def record(rank: int, failure: str) -> None:
    """Report the failure of a rank to the process that launched the ranks, if any.

    One line, written at once, so that lines of several ranks do not mix.
    """
    what = {"rank": rank, "failed": failure[:_LONGEST]}
    with suppress(OSError, KeyError):
        os.write(int(os.environ[RECORD]), f"{json.dumps(what)}\n".encode())


def in_a_line(failure: BaseException) -> str:
    """Name the type of an exception, and what it says."""
    return " ".join(f"{type(failure).__name__}: {failure}".split())


def _named(rank: int, ranks: Ranks, what: str) -> str:
    return f"rank {rank} of {ranks.size}: {what}"
