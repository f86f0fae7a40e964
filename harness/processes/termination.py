"""Ending at SIGTERM and SIGHUP as at Ctrl-C: processes end, and scratch folders go."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import current_thread, main_thread

_ONCE_SECONDS = 5.0  #: within which another signal does not interrupt the cleaning up


class TerminatedError(BaseException):
    """A signal asked this process to end. No `except` of ours or others' takes it."""


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Raise `TerminatedError` at SIGTERM or SIGHUP, and then exit by 128 + its number.

    Signals that somebody else handles, or ignores as nohup does, are left as they are,
    and so are all in a thread that is not the main one.
    """
    numbers = [
        number
        for number in (signal.SIGTERM, signal.SIGHUP)
        if current_thread() is main_thread()
        and signal.getsignal(number) is signal.SIG_DFL
    ]
    came: list[tuple[float, int]] = []

    def end(number: int, _: object) -> None:
        now = time.monotonic()
        if not came or now > came[-1][0] + _ONCE_SECONDS:
            came.append((now, number))
            raise TerminatedError

    for number in numbers:
        signal.signal(number, end)
    try:
        yield
    except BaseException:
        if came:  # whatever went wrong afterwards: a terminal that hung up, say
            raise SystemExit(128 + came[0][1]) from None
        raise
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)
