"""Waiting for events in other processes, on machines of any speed."""

import time

LONGEST = 600.0  #: seconds until a wait is given up


def soon(condition):
    """Wait until a condition holds; return False if it does not in time."""
    deadline = time.monotonic() + LONGEST
    while not (holds := condition()) and time.monotonic() < deadline:
        time.sleep(0.02)
    return holds
