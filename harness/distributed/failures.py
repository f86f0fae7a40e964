"""Collective handling of failures: all ranks raise, or all processes end.

If a single rank raised an exception, the other ranks might wait for its messages
forever. Work that may fail is therefore called by `run_collectively`. This function
then exchanges the outcomes of all ranks on a communicator that is used only for this
purpose. A rank whose work failed waits in this exchange for the other ranks. If another
rank does not arrive in time, it is probably waiting for a message of the failed rank.
In this case, the failed rank ends all processes (`abort`).
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

PEER_TIMEOUT = 5.0  #: longest time for which a failed rank waits for the other ranks, s
#: Environment variable with the number of a file descriptor. Through this descriptor,
#: ranks report failures to `harness.processes.ranks`, separately from the output of
#: solvers.
RECORD = "MORTARBENCH_RANK_RECORD"
#: interval at which a failed rank tests whether other ranks have arrived, s
_POLL_SECONDS = 1e-3
_MESSAGE_BYTES = 500  #: length to which descriptions of failures are truncated


class RankFailedError(Exception):
    """Error for the failure of a rank; the message names the rank and its exception."""


def run_collectively(ranks: Ranks, work: Callable[[], T]) -> T:
    """Call `work` on all ranks; raise on all ranks if `work` fails on any rank.

    If all ranks raise exceptions with equal messages, each rank re-raises its
    exception.

    Raises
    ------
    RankFailedError
        If `work` failed only on some ranks, or with different messages.

    """
    # The first access is collective, so all ranks must reach this line.
    comm = ranks.private_comm
    failure: Exception | None = None
    try:
        result = work()
    except Exception as e:
        failure = e
    message = np.zeros(_MESSAGE_BYTES, dtype=np.uint8)
    if failure is not None:
        text = in_a_line(failure).encode()[:_MESSAGE_BYTES]
        message[: len(text)] = np.frombuffer(text, dtype=np.uint8)
    messages = np.empty((ranks.size, _MESSAGE_BYTES), dtype=np.uint8)
    request = comm.Iallgather(message, messages)
    if failure is None:
        request.Wait()
    deadline = time.monotonic() + PEER_TIMEOUT
    while failure is not None and not request.Test():
        if time.monotonic() > deadline:
            abort(ranks, failure)
        time.sleep(_POLL_SECONDS)
    failed = np.flatnonzero(messages.any(axis=1))
    if not failed.size:
        return result
    if failure is not None and (messages == message).all():
        raise failure
    first = bytes(messages[failed[0]]).rstrip(b"\0").decode(errors="replace")
    raise RankFailedError(_named(int(failed[0]), ranks, first)) from failure


def abort(ranks: Ranks, failure: BaseException) -> NoReturn:
    """Report the failure of this rank, and end the processes of all ranks."""
    record(ranks.rank, _named(ranks.rank, ranks, in_a_line(failure)))
    with suppress(OSError, ValueError):  # a solver may have closed stderr
        traceback.print_exception(failure)
        sys.stderr.flush()
    ranks.comm.Abort(1)
    raise SystemExit(1)


def record(rank: int, failure: str) -> None:
    """Report the failure of a rank to the process that launched the ranks, if any.

    The report is a single write, so that reports of several ranks do not interleave.
    """
    entry = {"rank": rank, "failed": failure[:_MESSAGE_BYTES]}
    with suppress(OSError, KeyError):
        os.write(int(os.environ[RECORD]), f"{json.dumps(entry)}\n".encode())


def in_a_line(failure: BaseException) -> str:
    """Return the type and the message of an exception as one line."""
    return " ".join(f"{type(failure).__name__}: {failure}".split())


def _named(rank: int, ranks: Ranks, message: str) -> str:
    return f"rank {rank} of {ranks.size}: {message}"
