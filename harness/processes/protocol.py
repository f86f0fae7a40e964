"""Protocol between the parent and its workers: lines of JSON over two pipes.

The parent writes one request per line, and the worker answers each request with one or
more events. The worker ends when the pipe of requests is closed.

* ``{"event": "ready"}`` is sent once, when the worker accepts requests.
* ``{"warm_up": true}`` requests untimed preparations; reply: ``{"event": "warm"}``.
* Every other request is answered by ``{"event": "start"}``, at which the parent starts
  its clock, and by ``{"event": "done", …}`` with the answer. In a measurement, the
  worker sends ``{"event": "solved"}`` between these two events after the first solve,
  and ``{"event": "timed"}`` after the last one, when its own clock has stopped. If MPI
  ranks build the QP of a case, rank 0 sends ``{"event": "built", …}`` before "start",
  and ``{"event": "measured"}`` before the ranks evaluate the answer.
* ``{"event": "fault", "what": …}`` is sent instead of the next event if code of the
  harness fails.

A library that writes to the wrong file descriptor can mix other bytes into the replies;
`event_of` rejects such lines.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, TextIO

from mortarbench.harness.record import finite

#: size of the largest reply that is read, which bounds the required memory
MAX_REPLY_BYTES = 2**22
MAX_EXCERPT_CHARACTERS = 200  #: longest excerpt of an invalid reply in a message
MAX_FAULT_CHARACTERS = 2000  #: longest message of the event "fault"


@dataclass(frozen=True)
class Events:
    """Callbacks with which the handler of a request sends events to the parent."""

    start: Callable[[], None]  #: sends "start", at which the parent starts its clock
    solved: Callable[[], None]  #: sends "solved": the first solve has ended
    #: sends "timed": the worker's clock has stopped
    timed: Callable[[], None]
    #: sends "built" or "measured", with the entries of the event
    reached: Callable[[str, Mapping[str, Any]], None]


Handle = Callable[[dict[str, Any], Events], dict[str, Any]]


def answer_requests(
    handle: Handle,
    warm_up: Callable[[], dict[str, Any] | None],
    request_fd: int,
    reply_fd: int,
) -> None:
    """Answer requests until the pipe of requests is closed.

    handle : computes the answer to a request; called with the callbacks of its events
    warm_up : performs the warm-up; returns further entries of the reply, or None
    """
    # Programs that a solver starts must neither keep the pipes open nor write to them.
    for fd in (request_fd, reply_fd):
        os.set_inheritable(fd, False)
    with os.fdopen(request_fd) as requests, os.fdopen(reply_fd, "w") as replies:
        _send(replies, event="ready")
        while line := requests.readline():
            request = json.loads(line)
            try:
                if "warm_up" in request:
                    reply = {"event": "warm", **(warm_up() or {})}
                else:
                    answer = handle(request, _events(replies))
                    reply = {"event": "done", **answer}
                sys.stdout.flush()  # the next request truncates the log
            # fault of the harness: `handle` and `warm_up` catch errors of solvers
            except Exception as e:
                traceback.print_exc()
                what = " ".join(f"{type(e).__name__}: {e}".split())
                reply = {"event": "fault", "what": what[:MAX_FAULT_CHARACTERS]}
            _send(replies, **reply)


def _events(replies: TextIO) -> Events:
    def reached(event: str, entries: Mapping[str, Any]) -> None:
        _send(replies, event=event, **entries)

    return Events(
        lambda: _send(replies, event="start"),
        lambda: _send(replies, event="solved"),
        lambda: _send(replies, event="timed"),
        reached,
    )


def _send(replies: TextIO, **event: Any) -> None:
    replies.write(json.dumps(finite(event), allow_nan=False) + "\n")
    replies.flush()


class ForeignReplyError(Exception):
    """Error for a reply that violates the protocol; the message quotes its start."""


def event_of(line: bytes, expected: str) -> dict[str, Any]:
    """Check that a reply is the expected event or "fault", and return its entries.

    Raises
    ------
    ForeignReplyError
        If the line is not one of these two events.

    """
    try:
        reply = json.loads(line)
    except ValueError:
        raise ForeignReplyError(
            f"{_excerpt(line)} was received, expected a reply"
        ) from None
    if not isinstance(reply, dict) or reply.get("event") not in (expected, "fault"):
        raise ForeignReplyError(f"{_excerpt(line)} was received, expected {expected!r}")
    return reply


def _excerpt(line: bytes) -> str:
    text = repr(line[: MAX_EXCERPT_CHARACTERS + 1].decode(errors="backslashreplace"))
    return (
        text
        if len(line) <= MAX_EXCERPT_CHARACTERS
        else f"{text[:MAX_EXCERPT_CHARACTERS]}…"
    )


def measures(request: Mapping[str, Any]) -> bool:
    """Return True if a request is a measurement; other requests are not timed."""
    return "out" in request


class Source(StrEnum):
    """Origin of the QP of a measurement, which determines who judges the answer."""

    #: The worker and the parent read the QP from a file; the parent judges the answer
    FILE = "file"
    #: MPI ranks build the QP together. The parent builds it as well and judges the
    #: answer
    SHARES = "shares"
    #: MPI ranks build the QP together, and rank 0 judges the answer
    RANKS = "ranks"

    @property
    def is_shared(self) -> bool:
        """True if MPI ranks build the QP."""
        return self is not Source.FILE


def source_of(request: Mapping[str, Any]) -> Source:
    """Return the origin of the QP of a request."""
    return Source(request.get("source", Source.FILE))
