"""How much memory a solver may use, for those that would make dense matrices."""

from __future__ import annotations

import os

VARIABLE = "MORTARBENCH_MEMORY_MIB"  #: set for a worker to the limit of its suite


def memory_limit_mib() -> float:
    """Give the memory limit of this process; that of the machine where none is set."""
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**20
    return min(float(os.environ.get(VARIABLE, machine)), machine)


def too_large(n: int, copies: float = 1.0) -> str | None:
    """Give the reason to decline where dense (n, n) matrices would not fit, or None.

    copies : how many of them the solver holds at a time
    """
    needed, limit = copies * 8 * n**2 / 2**20, memory_limit_mib()
    if needed <= limit:
        return None
    return (
        f"needs {needed:.0f} MiB for dense matrices of {n} rows; "
        f"the limit is {limit:.0f} MiB"
    )
