"""A process that answers requests: one line of JSON on one pipe, some on another.

* it says ``{"event": "ready"}`` when it can be asked
* ``{"warm_up": true}``: it does what need not be timed, and says ``{"event": "warm"}``
* any other request: it says ``{"event": "start"}`` when it begins what is to be timed
  from outside, and ``{"event": "done", …}`` with its answer. One that measures says
  ``{"event": "timed"}`` when its clock has stopped, and waits for a line before it goes
  on: until then the parent looks at the CPU time of the process. One on ranks that make
  the QP of a case says ``{"event": "emitted", …}`` before "start", and
  ``{"event": "measured"}`` after "timed", before it judges the answer
* ``{"event": "fault", "what": …}`` in place of each: our own code failed

and ends when its requests do. A library that writes to the wrong file descriptor can
mix other bytes into the replies: `event_of` refuses them.
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

MAX_REPLY_BYTES = 2**22  #: bytes
MAX_EXCERPT_CHARACTERS = 200  #: characters of a foreign reply that a message repeats
MAX_FAULT_CHARACTERS = 2000  #: characters


@dataclass(frozen=True)
class Events:
    """What the handler of a request calls while it measures."""

    start: Callable[[], None]  #: the clock starts
    timed: Callable[[], None]  #: it has stopped; returns when the parent has looked
    #: a stage beside the clock is done, by its name, with what is to be told of it
    reached: Callable[[str, Mapping[str, Any]], None]


Handle = Callable[[dict[str, Any], Events], dict[str, Any]]


def answer_requests(
    handle: Handle,
    warm_up: Callable[[], dict[str, Any] | None],
    request_fd: int,
    reply_fd: int,
) -> None:
    """Answer requests until there are no more.

    handle : takes a request and what to call meanwhile; returns the answer
    warm_up : returns what is to be told of it
    """
    for fd in (request_fd, reply_fd):
        os.set_inheritable(
            fd, False
        )  # programs that a solver starts have no use for it
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
                sys.stdout.flush()  # what was printed belongs to this request
            except Exception as e:  # ours: handlers let nothing through that is not
                traceback.print_exc()
                what = " ".join(f"{type(e).__name__}: {e}".split())
                reply = {"event": "fault", "what": what[:MAX_FAULT_CHARACTERS]}
            _send(replies, **reply)


def _events(requests: TextIO, replies: TextIO) -> Events:
    def timed() -> None:
        _send(replies, event="timed")
        requests.readline()

    def reached(event: str, told: Mapping[str, Any]) -> None:
        _send(replies, event=event, **told)

    return Events(lambda: _send(replies, event="start"), timed, reached)


def _send(replies: TextIO, **event: Any) -> None:
    replies.write(json.dumps(finite(event), allow_nan=False) + "\n")
    replies.flush()


class ForeignReplyError(Exception):
    """A reply that none of our processes sends; the message repeats its beginning."""


def event_of(line: bytes, expected: str) -> dict[str, Any]:
    """Parse a reply: an event of the expected name, or "fault".

    Raises
    ------
    ForeignReplyError
        When the line is anything else.

    """
    try:
        reply = json.loads(line)
    except ValueError:
        raise ForeignReplyError(f"{_shown(line)} came, expected a reply") from None
    if not isinstance(reply, dict) or reply.get("event") not in (expected, "fault"):
        raise ForeignReplyError(f"{_shown(line)} came, expected {expected!r}")
    return reply


def _shown(line: bytes) -> str:
    text = repr(line[: MAX_EXCERPT_CHARACTERS + 1].decode(errors="backslashreplace"))
    return (
        text
        if len(line) <= MAX_EXCERPT_CHARACTERS
        else f"{text[:MAX_EXCERPT_CHARACTERS]}…"
    )


def measures(request: Mapping[str, Any]) -> bool:
    """Return True for a measurement, which is the only request with a clock."""
    return "out" in request


class Source(StrEnum):
    """The origin of the QP of a measurement, and the judge of the answer."""

    FILE = "file"  #: a file, which the parent reads, too, and judges by
    SHARES = "shares"  #: ranks, each its share; the parent judges by the whole
    RANKS = "ranks"  #: ranks, which judge the answer together: nobody has the whole

    @property
    def is_shared(self) -> bool:
        """True where ranks make the QP."""
        return self is not Source.FILE


def source_of(request: Mapping[str, Any]) -> Source:
    """Return the source of the QP that a request is about."""
    return Source(request.get("source", Source.FILE))
