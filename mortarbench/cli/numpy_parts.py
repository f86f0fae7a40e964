"""Parts of numpy that no process of ours needs."""

from __future__ import annotations

import sys
from importlib.util import LazyLoader, find_spec, module_from_spec


def defer_parts_of_numpy() -> None:
    """Execute modules of numpy that scipy imports only when their names are used.

    Nothing here uses them, and they take a quarter of the time in which a process that
    solves starts: `scipy._lib.array_api_compat.numpy` asks for every name of numpy.
    """
    import numpy

    for part in ("f2py", "testing"):
        spec = find_spec(f"numpy.{part}")
        if spec is None or spec.loader is None or spec.name in sys.modules:
            continue
        spec.loader = LazyLoader(spec.loader)
        module = sys.modules[spec.name] = module_from_spec(spec)
        spec.loader.exec_module(module)
        setattr(numpy, part, module)  # or numpy would ask for it again
