"""Protocol between the parent and its workers: lines of JSON over two pipes.

The parent writes one request per line, and the process answers it by one or more
events. It ends when the pipe of requests is closed.

* ``{"event": "ready"}`` is sent once, when the process accepts requests.
* ``{"warm_up": true}`` requests untimed preparations; reply: ``{"event": "warm"}``.
* Every other request is answered by ``{"event": "start"}``, at which the parent starts
  its clock, and by ``{"event": "done", …}`` with the answer. In a measurement,
  ``{"event": "timed"}`` comes between the two events, when the worker's clock has
  stopped. The worker then waits for a line, so that the parent can read its CPU time.
  Ranks that emit the QP of a case send ``{"event": "emitted", …}`` before "start". They
  send ``{"event": "measured"}`` after "timed", before they evaluate the answer.
* ``{"event": "fault", "what": …}`` replaces any of these if our own code fails.

A library that writes to the wrong file descriptor can mix other bytes into the replies;
`event_of` refuses them.
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

MAX_REPLY_BYTES = 2**22  #: bounds the memory to read one reply of foreign code
MAX_EXCERPT_CHARACTERS = 200  #: length of a foreign reply that is quoted in a message
MAX_FAULT_CHARACTERS = 2000  #: length of the message of a fault


@dataclass(frozen=True)
class Events:
    """Callbacks by which the handler of a request reports its progress."""

    start: Callable[[], None]  #: reports that the clock starts
    #: reports that it has stopped; returns when the parent has read the CPU time
    timed: Callable[[], None]
    #: reports the end of a stage outside the clock: name of the event, its entries
    reached: Callable[[str, Mapping[str, Any]], None]


Handle = Callable[[dict[str, Any], Events], dict[str, Any]]


def answer_requests(
    handle: Handle,
    warm_up: Callable[[], dict[str, Any] | None],
    request_fd: int,
    reply_fd: int,
) -> None:
    """Answer requests until the pipe of requests is closed.

    handle : computes the answer to a request, with callbacks that report its progress
    warm_up : performs the warm-up; returns entries of the reply, or None
    """
    # A program that a solver starts must not hold the pipes open, or write into them.
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
                    answer = handle(request, _events(requests, replies))
                    reply = {"event": "done", **answer}
                sys.stdout.flush()  # the log is truncated at the next request
            except Exception as e:  # our own fault: handlers catch those of solvers
                traceback.print_exc()
                what = " ".join(f"{type(e).__name__}: {e}".split())
                reply = {"event": "fault", "what": what[:MAX_FAULT_CHARACTERS]}
            _send(replies, **reply)


def _events(requests: TextIO, replies: TextIO) -> Events:
    def timed() -> None:
        _send(replies, event="timed")
        requests.readline()

    def reached(event: str, entries: Mapping[str, Any]) -> None:
        _send(replies, event=event, **entries)

    return Events(lambda: _send(replies, event="start"), timed, reached)


def _send(replies: TextIO, **event: Any) -> None:
    replies.write(json.dumps(finite(event), allow_nan=False) + "\n")
    replies.flush()


class ForeignReplyError(Exception):
    """Reply that violates the protocol; the message quotes its beginning."""


def event_of(line: bytes, expected: str) -> dict[str, Any]:
    """Parse a reply: an event of the expected name, or "fault".

    Raises
    ------
    ForeignReplyError
        If the line is anything else.

    """
    try:
        reply = json.loads(line)
    except ValueError:
        raise ForeignReplyError(f"{_excerpt(line)} came, expected a reply") from None
    if not isinstance(reply, dict) or reply.get("event") not in (expected, "fault"):
        raise ForeignReplyError(f"{_excerpt(line)} came, expected {expected!r}")
    return reply


def _excerpt(line: bytes) -> str:
    text = repr(line[: MAX_EXCERPT_CHARACTERS + 1].decode(errors="backslashreplace"))
    return (
        text
        if len(line) <= MAX_EXCERPT_CHARACTERS
        else f"{text[:MAX_EXCERPT_CHARACTERS]}…"
    )


def measures(request: Mapping[str, Any]) -> bool:
    """Return True if a request is a measurement, the only kind with a clock."""
    return "out" in request


class Source(StrEnum):
    """Origin of the QP of a measurement, and with it the judge of the answer."""

    FILE = "file"  #: a file; the parent reads it as well, and judges
    SHARES = "shares"  #: ranks emit a share each; the parent judges by the entire QP
    RANKS = "ranks"  #: ranks emit a share each and judge together; none has all of it

    @property
    def is_shared(self) -> bool:
        """True if ranks emit the QP."""
        return self is not Source.FILE


def source_of(request: Mapping[str, Any]) -> Source:
    """Return the origin of the QP of a request."""
    return Source(request.get("source", Source.FILE))
