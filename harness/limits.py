"""How many threads and how much memory a solver may use, and a case."""

from __future__ import annotations

import os

from mortarbench.harness.errors import InputError, shown

#: environment variables that keep libraries to one thread, read when they load
ONE_THREAD = {
    f"{library}_NUM_THREADS": "1"
    for library in ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMEXPR", "RAYON")
}
CASE_VARIABLE = "MORTARBENCH_CASE_MIB"  #: what building a case may take, see `fits`
VARIABLE = "MORTARBENCH_MEMORY_MIB"  #: set for a worker to the limit of its suite


def memory_limit_mib() -> float:
    """Give the memory limit of this process; that of the machine where none is set."""
    machine = _machine_mib()
    return min(float(os.environ.get(VARIABLE, machine)), machine)


def case_limit_mib() -> float:
    """Give the memory that building a case may take: the machine's, if none is set.

    Raises
    ------
    InputError
        When the environment variable is no positive number.

    """
    text = os.environ.get(CASE_VARIABLE)
    if text is None:
        return _machine_mib()
    try:
        limit = float(text)
    except ValueError:
        limit = 0.0
    if not limit > 0:
        raise InputError(
            f"{CASE_VARIABLE} = {shown(text)}; expected a number of MiB, such as 65536"
        )
    return limit


def _machine_mib() -> float:
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**20


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
