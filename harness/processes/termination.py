"""Clean exit on SIGTERM and SIGHUP: workers are ended and scratch folders removed."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import current_thread, main_thread

#: time after a signal within which a second signal does not interrupt the cleanup
_ONCE_SECONDS = 5.0


class TerminatedError(BaseException):
    """Exception for a termination signal, which `except Exception` does not catch."""


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """On SIGTERM or SIGHUP, unwind the block and exit with code 128 + signal number.

    The block is unwound by a `TerminatedError`. Signals that already have a handler or
    are ignored (nohup ignores SIGHUP) keep their disposition. In threads other than the
    main thread, no handler is set, because Python permits this only in the main thread.
    """
    numbers = [
        number
        for number in (signal.SIGTERM, signal.SIGHUP)
        if current_thread() is main_thread()
        and signal.getsignal(number) is signal.SIG_DFL
    ]
    received: list[tuple[float, int]] = []  # arrival time and number of each signal

    def end(number: int, _: object) -> None:
        now = time.monotonic()
        # A second signal must not interrupt the `finally` blocks that run because of
        # the first signal. A much later signal, however, must end a cleanup that hangs.
        if not received or now > received[-1][0] + _ONCE_SECONDS:
            received.append((now, number))
            raise TerminatedError

    for number in numbers:
        signal.signal(number, end)
    try:
        yield
    except BaseException:
        # The error may also be an OSError, caused by a write to a closed terminal.
        if received:
            raise SystemExit(128 + received[0][1]) from None
        raise
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)
