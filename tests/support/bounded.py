"""Limits of time and memory for code under test."""

import re
import resource
import signal
from contextlib import contextmanager
from pathlib import Path

_SPARE = 4 * 2**30  #: further bytes of address space, which allocators may reserve


class HangError(BaseException):
    """Timeout, raised as a BaseException so that file readers do not catch it."""


@contextmanager
def bounded(seconds=300, mib=1024):
    """Raise `HangError` after `seconds`; assert that the memory peak grew by ≤ `mib`.

    The address space is limited to a much larger value, which protects the machine.
    """

    def ring(*_):
        raise HangError

    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    used, _ = _status()
    before = signal.signal(signal.SIGALRM, ring)
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_address_space() + _SPARE, limits[1]))
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        resource.setrlimit(resource.RLIMIT_AS, limits)
    _, peak = _status()
    assert peak - used <= mib * 1024, f"took {(peak - used) / 1024:.0f} MiB"


def _status():
    """Return the resident memory and its peak, in KiB."""
    text = Path("/proc/self/status").read_text()
    return [int(re.search(rf"{name}:\s+(\d+)", text)[1]) for name in ("VmRSS", "VmHWM")]


def _address_space():
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
