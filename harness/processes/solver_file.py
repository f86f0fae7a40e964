"""Solver objects stored in files, from which worker processes load copies.

Unlike pickle, cloudpickle stores functions and classes of `__main__` (a script or a
notebook) with their code. For functions and classes of other modules, cloudpickle
stores only the names. The folders in which this process finds modules are therefore
also stored; a worker searches them after its own.
"""

from __future__ import annotations

import os
import pickle
import sys
from pathlib import Path
from typing import Any

from mortarbench.harness.errors import InputError, described, one_line
from mortarbench.harness.plugin import Solver


def write_solver(path: Path, solver: Solver) -> None:
    """Store a copy of a solver.

    Raises
    ------
    InputError
        If the solver refers to an object that cannot be copied, such as an open file.

    """
    import cloudpickle  # not needed for solvers of the registry

    kind = type(solver).__name__
    try:
        content = cloudpickle.dumps(solver)
    except Exception as e:  # raised by any __reduce__ that is called
        raise InputError(
            f"solver {kind} cannot be copied into a worker process: "
            f"{one_line(str(e) or type(e).__name__)}; expected attributes that can be "
            "pickled, or its name and plugins=[FILE.py]"
        ) from None
    path.write_bytes(pickle.dumps(([*map(os.path.abspath, sys.path)], content)))


def read_solver(path: Path) -> Any:
    """Load a solver from a file written by `write_solver`.

    The file is unpickled, so it must have been written by a process of the same user.

    Raises
    ------
    InputError
        If the solver cannot be rebuilt, for instance because a module to which it
        refers cannot be imported.

    """
    try:
        folders, content = pickle.loads(path.read_bytes())
        sys.path += [folder for folder in folders if folder not in sys.path]
        return pickle.loads(content)
    except Exception as e:  # raised by a __setstate__, or by an imported module
        raise InputError(
            f"the solver cannot be rebuilt in a worker process: {described(e)}; "
            "expected its name and plugins=[FILE.py]"
        ) from None
