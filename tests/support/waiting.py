"""Waiting for events in other processes, on machines of any speed."""

import time

LONGEST = 600.0  #: maximum waiting time, s


def soon(condition):
    """Wait until a condition is true; return False after `LONGEST` seconds."""
    deadline = time.monotonic() + LONGEST
    while not (holds := condition()) and time.monotonic() < deadline:
        time.sleep(0.02)
    return holds
