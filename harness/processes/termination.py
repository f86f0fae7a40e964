"""Clean exit at SIGTERM and SIGHUP: processes end and scratch folders are removed."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import current_thread, main_thread

#: within this time after a signal, a further one does not interrupt the cleanup
_ONCE_SECONDS = 5.0


class TerminatedError(BaseException):
    """Termination by a signal, of a type that `except Exception` does not catch."""


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Raise `TerminatedError` on SIGTERM or SIGHUP; exit with 128 + signal number.

    Signals that are handled elsewhere, or ignored (nohup ignores SIGHUP), keep their
    disposition. Outside the main thread nothing changes, because Python allows signal
    handlers to be set only in the main thread.
    """
    numbers = [
        number
        for number in (signal.SIGTERM, signal.SIGHUP)
        if current_thread() is main_thread()
        and signal.getsignal(number) is signal.SIG_DFL
    ]
    received: list[tuple[float, int]] = []  # time and number

    def end(number: int, _: object) -> None:
        now = time.monotonic()
        # A second signal must not interrupt the `finally` blocks that the first one
        # runs; one that comes later ends a cleanup that hangs.
        if not received or now > received[-1][0] + _ONCE_SECONDS:
            received.append((now, number))
            raise TerminatedError

    for number in numbers:
        signal.signal(number, end)
    try:
        yield
    except BaseException:
        # Also for a later error: writing to a terminal that hung up raises OSError.
        if received:
            raise SystemExit(128 + received[0][1]) from None
        raise
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)
