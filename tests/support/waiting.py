"""Waiting for events in other processes, on machines of any speed."""

import time
from contextlib import suppress

import psutil

LONGEST = 600.0  #: maximum waiting time, s


def soon(condition):
    """Wait until a condition is true; return False after `LONGEST` seconds."""
    deadline = time.monotonic() + LONGEST
    while not (holds := condition()) and time.monotonic() < deadline:
        time.sleep(0.02)
    return holds


def is_alive(process):
    """Return True if a process exists and is not a zombie."""
    with suppress(psutil.NoSuchProcess):
        return psutil.Process(process).status() != psutil.STATUS_ZOMBIE
    return False
