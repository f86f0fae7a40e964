"""Solver objects stored in files, from which worker processes load copies.

Unlike pickle, cloudpickle stores functions and classes of `__main__` (a script or a
notebook) with their code. For functions and classes of other modules, cloudpickle
stores only the names. A worker would not find plug-ins or modules in the folder of the
script, since workers do not search the working directory. Such modules are therefore
also stored with their code.
"""

from __future__ import annotations

import os
import pickle
import sys
import sysconfig
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from site import getsitepackages, getusersitepackages
from types import ModuleType
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
    with ExitStack() as stack:
        for module in _modules_unknown_to_workers():
            cloudpickle.register_pickle_by_value(module)
            stack.callback(cloudpickle.unregister_pickle_by_value, module)
        try:
            content = cloudpickle.dumps(solver)
        except Exception as e:  # raised by any __reduce__ that is called
            raise InputError(
                f"solver {kind} cannot be copied into a worker process: "
                f"{one_line(str(e) or type(e).__name__)}; expected attributes that can "
                "be pickled, or its name and plugins=[FILE.py]"
            ) from None
    path.write_bytes(content)


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
        return pickle.loads(path.read_bytes())
    except Exception as e:  # raised by a __setstate__, or by an imported module
        raise InputError(
            f"the solver cannot be rebuilt in a worker process: {described(e)}; "
            "expected its name and plugins=[FILE.py]"
        ) from None


def _modules_unknown_to_workers() -> Iterator[ModuleType]:
    """Yield loaded modules that a worker would not find.

    A worker finds mortarbench, the standard library, and modules in site packages or
    PYTHONPATH.
    """
    paths = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    paths += [sysconfig.get_path("stdlib"), getusersitepackages(), *getsitepackages()]
    known = tuple(f"{os.path.realpath(path)}{os.sep}" for path in filter(None, paths))
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if (
            isinstance(module, ModuleType)
            and str(file).endswith(".py")
            and name == module.__name__ != "__main__"
            and name.partition(".")[0] != "mortarbench"
            and not os.path.realpath(str(file)).startswith(known)
        ):
            yield module
