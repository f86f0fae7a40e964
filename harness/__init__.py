"""The contract between problems, solvers and reports, and the clock.

A name is imported when it is asked for: what only reads names of cases and solvers
needs neither numpy nor scipy, and a refusal should not wait for them. Nor should a
process of a run wait for parts of numpy that nothing here uses, see `_Unused`.
"""

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import LazyLoader
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from harness.errors import InputError
    from harness.files.qpfile import save_qp
    from harness.limits import memory_limit_mib, too_large
    from harness.mechanics import Friction, Grid, Mechanics
    from harness.plugin import (
        About,
        Case,
        Chained,
        ContactSide,
        Family,
        Fields,
        Reference,
        ReferenceOverRanks,
        Solver,
        Tightening,
        Value,
    )
    from harness.qp import QP, Matrix, Structure, Vector, needs_matrices, no_rows
    from harness.record import Record, Verdict
    from harness.solution import Solution, Status
    from harness.verify.certificate import Certificate, UncertifiableError, certify
    from harness.verify.kkt import Residuals, kkt_residuals, verdict

_MODULES = {
    "About": "harness.plugin",
    "Case": "harness.plugin",
    "Certificate": "harness.verify.certificate",
    "Chained": "harness.plugin",
    "Family": "harness.plugin",
    "ContactSide": "harness.plugin",
    "Fields": "harness.plugin",
    "Friction": "harness.mechanics",
    "Grid": "harness.mechanics",
    "InputError": "harness.errors",
    "Matrix": "harness.qp",
    "Mechanics": "harness.mechanics",
    "QP": "harness.qp",
    "Record": "harness.record",
    "Reference": "harness.plugin",
    "ReferenceOverRanks": "harness.plugin",
    "Residuals": "harness.verify.kkt",
    "Solution": "harness.solution",
    "Solver": "harness.plugin",
    "Status": "harness.solution",
    "Structure": "harness.qp",
    "UncertifiableError": "harness.verify.certificate",
    "Tightening": "harness.plugin",
    "Value": "harness.plugin",
    "Vector": "harness.qp",
    "Verdict": "harness.record",
    "certify": "harness.verify.certificate",
    "kkt_residuals": "harness.verify.kkt",
    "memory_limit_mib": "harness.limits",
    "needs_matrices": "harness.qp",
    "no_rows": "harness.qp",
    "save_qp": "harness.files.qpfile",
    "too_large": "harness.limits",
    "verdict": "harness.verify.kkt",
}


class _Unused(MetaPathFinder):
    """Executes parts of numpy when something of them is used first, and not before.

    scipy imports all names of numpy, these modules among them, see
    ``scipy/_lib/array_api_compat/numpy/__init__.py``: a quarter of what a process of
    ours takes to start.
    """

    _NAMES = ("numpy.f2py", "numpy.testing")

    def find_spec(
        self, name: str, path: Sequence[str] | None, _target: ModuleType | None = None
    ) -> ModuleSpec | None:
        spec = PathFinder.find_spec(name, path) if name in self._NAMES else None
        if spec is not None and spec.loader is not None:
            spec.loader = LazyLoader(spec.loader)
        return spec


sys.meta_path.insert(0, _Unused())


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return value


__all__ = [
    "QP",
    "About",
    "Case",
    "Certificate",
    "Chained",
    "ContactSide",
    "Family",
    "Fields",
    "Friction",
    "Grid",
    "InputError",
    "Matrix",
    "Mechanics",
    "Record",
    "Reference",
    "ReferenceOverRanks",
    "Residuals",
    "Solution",
    "Solver",
    "Status",
    "Structure",
    "Tightening",
    "UncertifiableError",
    "Value",
    "Vector",
    "Verdict",
    "certify",
    "kkt_residuals",
    "memory_limit_mib",
    "needs_matrices",
    "no_rows",
    "save_qp",
    "too_large",
    "verdict",
]
