"""Waiting for what another process does, on machines of any speed."""

import time

LONGEST = 600.0  #: seconds; what never comes is given up then


def soon(condition):
    """Wait until a condition holds; returns whether it does, at the latest then."""
    deadline = time.monotonic() + LONGEST
    while not (holds := condition()) and time.monotonic() < deadline:
        time.sleep(0.02)
    return holds
