"""Availability of MPI, and the number of ranks of a solve."""

from __future__ import annotations

import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

from mortarbench.harness.errors import InputError, shown

MAX_RANKS = 4096
MISSING = (
    "needs mpi4py and an mpiexec; expected `pip install 'mortarbench[mpi]'`, or an MPI "
    "of the system with an mpi4py that was built for it"
)


def mpiexec() -> str | None:
    """Return the path of mpiexec, or None if mpiexec or mpi4py is not installed.

    An mpiexec in the folder of the Python interpreter is preferred to an mpiexec on
    PATH.
    """
    if find_spec("mpi4py") is None:
        return None
    beside = Path(sys.executable).with_name("mpiexec")
    return str(beside) if beside.is_file() else shutil.which("mpiexec")


def ranks_asked(count: object, where: str) -> int:
    """Check a number of ranks, and return it.

    where : option or key that sets the number, for the message

    Raises
    ------
    InputError
        If `count` is not an integer from 1 to MAX_RANKS, or if it exceeds 1 and MPI is
        not available.

    """
    if type(count) is not int or not 1 <= count <= MAX_RANKS:
        raise InputError(
            f"{where} = {shown(count)}; expected a number of ranks, 1 to {MAX_RANKS}"
        )
    if count > 1 and mpiexec() is None:
        raise InputError(f"{where} = {count} {MISSING}")
    return count


def too_few_parts(parts: int, ranks: int) -> str:
    """Return the message for a case that so many ranks cannot build together."""
    if parts == 1:
        return (
            "the case is not in subdomains; expected one rank, or a dual in subdomains"
        )
    return f"{ranks} ranks for {parts} subdomains; expected at most one rank for each"
