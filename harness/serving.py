"""A process that answers requests: one line of JSON on one pipe, some on another.

* it says ``{"event": "ready"}`` when it can be asked
* ``{"warm_up": true}``: it does what need not be timed, and says ``{"event": "warm"}``
* any other request: it says ``{"event": "start"}`` when it begins what is to be timed
  from outside, and ``{"event": "done", …}`` with its answer

and ends when its requests do.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
from collections.abc import Callable
from typing import Any, TextIO

Handle = Callable[[dict[str, Any], Callable[[], None]], dict[str, Any]]

_PR_SET_PDEATHSIG = 1  # prctl(2)


def answer_requests(
    handle: Handle,
    warm_up: Callable[[], dict[str, Any] | None],
    request_fd: int,
    reply_fd: int,
) -> None:
    """Answer requests until there are no more.

    handle : takes a request and what to call at the start; returns the answer
    warm_up : returns what is to be told of it
    """
    _die_with_parent()
    with os.fdopen(request_fd) as requests, os.fdopen(reply_fd, "w") as replies:
        _send(replies, event="ready")
        for line in requests:
            request = json.loads(line)
            if "warm_up" in request:
                _send(replies, event="warm", **(warm_up() or {}))
                continue
            answer = handle(request, lambda: _send(replies, event="start"))
            sys.stdout.flush()  # what was printed belongs to this request
            _send(replies, event="done", **answer)


def _send(replies: TextIO, **event: Any) -> None:
    replies.write(json.dumps(event) + "\n")
    replies.flush()


def _die_with_parent() -> None:
    """Have the kernel kill us when the parent dies, even in the middle of a solve."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
