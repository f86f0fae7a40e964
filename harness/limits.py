"""Limits on the threads and the memory of solvers, and on the memory for cases."""

from __future__ import annotations

import os
from contextlib import suppress

from mortarbench.harness.errors import InputError, shown

#: Environment variables that limit numerical libraries to one thread. A library reads
#: its variable when it is loaded.
ONE_THREAD = {
    f"{library}_NUM_THREADS": "1"
    for library in ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMEXPR", "RAYON")
}
#: Environment variable with the memory limit for building a case, in MiB.
CASE_VARIABLE = "MORTARBENCH_CASE_MIB"
#: Environment variable with the memory limit of a suite, in MiB, which is set for the
#: workers of the suite.
VARIABLE = "MORTARBENCH_MEMORY_MIB"
_MAX_MIB = 1e12


def memory_limit_mib() -> float:
    """Return the memory limit of this process in MiB, at most the physical memory."""
    machine = _machine_mib()
    return min(float(os.environ.get(VARIABLE, machine)), machine)


def case_limit_mib() -> float:
    """Return the memory limit for building a case, in MiB."""
    return limit_of(CASE_VARIABLE, _machine_mib())


def limit_of(variable: str, default: float) -> float:
    """Return the limit that an environment variable sets, in MiB.

    Raises
    ------
    InputError
        If the environment variable is set to a value that is not a positive number.

    """
    text = os.environ.get(variable, str(default))
    with suppress(ValueError):
        if 0 < float(text) <= _MAX_MIB:
            return float(text)
    raise InputError(
        f"{variable} = {shown(text)}; expected a positive number of MiB, such as 65536"
    )


def _machine_mib() -> float:
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**20


def too_large(n: int, copies: float = 1.0) -> str | None:
    """Return the reason to decline if dense matrices exceed the memory limit, or None.

    n : number of rows and columns of each matrix
    copies : number of these matrices that the solver stores at the same time
    """
    needed, limit = copies * 8 * n**2 / 2**20, memory_limit_mib()
    if needed <= limit:
        return None
    return (
        f"needs {needed:.0f} MiB for dense matrices of {n} rows; "
        f"the limit is {limit:.0f} MiB"
    )
