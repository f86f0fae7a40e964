"""Protocol between the parent and its workers: lines of JSON over two pipes.

The parent writes one request per line, and the worker answers each request with one or
more events. The worker ends when the pipe of requests is closed.

* ``{"event": "ready"}`` is sent once, when the worker accepts requests.
* ``{"warm_up": true}`` requests untimed preparations; reply: ``{"event": "warm"}``.
* Every other request is answered by ``{"event": "start"}``, at which the parent starts
  its clock, and by ``{"event": "done", …}`` with the answer. In a measurement, the
  worker sends ``{"event": "solved"}`` between these two events after the first solve,
  and ``{"event": "timed"}`` after the last one, when its own clock has stopped. If the
  worker builds the QP of a case itself, it sends ``{"event": "built", …}`` before
  "start", and ``{"event": "measured"}`` before it evaluates the answer.
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
from contextlib import suppress
from typing import Any

from mortarbench.harness.errors import described, one_line, shortened
from mortarbench.harness.record import finite

#: size of the largest reply that is read, which bounds the required memory
MAX_REPLY_BYTES = 2**22
MAX_EXCERPT_CHARACTERS = 200  #: longest excerpt of an invalid reply in a message

#: sends an event, specified by its name and by its entries as keyword arguments
Send = Callable[..., None]


def answer_requests(
    answer: Callable[[dict[str, Any], Send], Mapping[str, Any]],
    request_fd: int,
    reply_fd: int,
) -> None:
    """Answer requests until the pipe of requests is closed.

    answer : returns the entries of the last event of a request; it sends the other
        events
    """
    # Programs that a solver starts must neither keep the pipes open nor write to them.
    for fd in (request_fd, reply_fd):
        os.set_inheritable(fd, False)
    with os.fdopen(request_fd) as requests, os.fdopen(reply_fd, "w") as replies:

        def send(event: str, **entries: Any) -> None:
            reply = finite({"event": event, **entries})
            replies.write(json.dumps(reply, allow_nan=False) + "\n")
            replies.flush()

        send("ready")
        while line := requests.readline():
            request = json.loads(line)
            try:
                reply = answer(request, send)
                sys.stdout.flush()  # the next request truncates the log
            except Exception as e:  # fault of the harness, not of a solver
                traceback.print_exc()
                send("fault", what=one_line(described(e)))
            else:
                send("warm" if "warm_up" in request else "done", **reply)


def event_of(line: bytes, expected: str) -> dict[str, Any]:
    """Check that a reply is the expected event or "fault", and return its entries.

    Raises
    ------
    ValueError
        If the line is not one of these two events; the message quotes its start.

    """
    reply = None
    with suppress(ValueError, RecursionError):
        reply = json.loads(line)
    if isinstance(reply, dict) and reply.get("event") in (expected, "fault"):
        return reply
    text = repr(line[: 2 * MAX_EXCERPT_CHARACTERS].decode(errors="backslashreplace"))
    raise ValueError(
        f"{shortened(text, MAX_EXCERPT_CHARACTERS)} was received, expected {expected!r}"
    )
