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
    """Return the path of mpiexec, beside this Python or on PATH; None without MPI."""
    if find_spec("mpi4py") is None:
        return None
    beside = Path(sys.executable).with_name("mpiexec")
    return str(beside) if beside.is_file() else shutil.which("mpiexec")


def ranks_asked(count: object, where: str) -> int:
    """Check a number of ranks; if it exceeds one, check also that MPI is available.

    where : option or key, for the message

    Raises
    ------
    InputError
        When `count` is not an integer from 1 to MAX_RANKS, or MPI is missing.

    """
    if type(count) is not int or not 1 <= count <= MAX_RANKS:
        raise InputError(
            f"{where} = {shown(count)}; expected a number of ranks, 1 to {MAX_RANKS}"
        )
    if count > 1 and mpiexec() is None:
        raise InputError(f"{where} = {count} {MISSING}")
    return count
