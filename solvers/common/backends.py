"""Lists of the backends of qpsolvers and cvxpy, without importing these libraries.

Importing either library imports every installed backend, which takes a second.
Therefore the names of the adapter files inside the library provide the list of
backends, and the import statements of these files show the packages that each backend
needs.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from mortarbench.solvers import SOLVERS
from mortarbench.solvers.common.adapter import Adapter
from mortarbench.solvers.common.conversion import NEGLIGIBLE, OBJECTIVE_SIZE


@dataclass(frozen=True)
class Call:
    """Keyword arguments and scaling for one backend of a solver library."""

    #: keywords whose value is max(tighter·tol, floor)
    tolerances: tuple[str, ...] = ()
    fixed: Mapping[str, Any] = field(default_factory=dict)  #: other keyword arguments
    size: float = OBJECTIVE_SIZE  #: ‖q‖∞ after the scaling of the objective
    tighter: float = 1.0
    floor: float = 0.0

    def options(self, tol: float) -> dict[str, Any]:
        """Return all keyword arguments of the backend for the tolerance `tol`."""
        value = max(self.tighter * tol, self.floor)
        return {**dict.fromkeys(self.tolerances, value), **self.fixed}


#: arguments for each backend, in lower case; others run with their defaults
CALLS: Mapping[str, Call] = {
    "clarabel": Call(("tol_feas", "tol_gap_abs", "tol_gap_rel"), {"max_threads": 1}),
    "cvxopt": Call(("feastol", "abstol", "reltol")),
    "daqp": Call(("primal_tol", "dual_tol"), size=1.0, tighter=1e-3, floor=1e-11),
    "highs": Call(
        ("primal_feasibility_tolerance", "dual_feasibility_tolerance"),
        # by default HiGHS adds 1e-7 to the Hessian and drops entries below 1e-9
        {
            "qp_regularization_value": 0.0,
            "small_matrix_value": 1e-12,
            "threads": 1,
            "qp_iteration_limit": 1_000_000,  # without a limit, HiGHS may cycle
        },
        size=1.0,
        tighter=1e-2,
        floor=1e-10,
    ),
    "osqp": Call(
        ("eps_rel",),
        {"eps_abs": NEGLIGIBLE, "max_iter": 1_000_000, "polishing": False},
    ),
    "piqp": Call(
        ("eps_rel", "eps_duality_gap_rel"),
        {"eps_abs": NEGLIGIBLE, "eps_duality_gap_abs": NEGLIGIBLE},
    ),
    "proxqp": Call(
        ("eps_rel", "eps_duality_gap_rel"),
        {
            "eps_abs": NEGLIGIBLE,
            "eps_duality_gap_abs": NEGLIGIBLE,
            "check_duality_gap": True,
        },
    ),
    "qoco": Call(("reltol", "reltol_inacc"), {"abstol": NEGLIGIBLE}),
    "qpalm": Call(("eps_rel",), {"eps_abs": NEGLIGIBLE}),
    "qtqp": Call(("tol_feas", "tol_gap_abs", "tol_gap_rel")),
    "scs": Call(("eps_rel",), {"eps_abs": NEGLIGIBLE, "max_iters": 1_000_000}),
    "sip": Call(("eps_rel",), {"eps_abs": NEGLIGIBLE}),
}


def call_of(backend: str) -> Call:
    """Return the arguments for a backend of qpsolvers or cvxpy."""
    return CALLS.get(backend.lower(), Call())


@dataclass(frozen=True)
class BackendAdapter(Adapter):
    """Adapter of a library that calls other libraries."""

    backend: str = ""  #: name of the backend, after the colon in the solver's name

    def library(self) -> Any:
        """Return the settings that the backend's own adapter lists, or None."""
        direct: Any = SOLVERS.get(self.backend.lower())
        return direct.library() if isinstance(direct, Adapter) else None


def adapter_files(library: str, pattern: str, suffix: str) -> dict[str, Path]:
    """Return the path of each backend's adapter file, keyed by the backend's name.

    Parameters
    ----------
    library : name of a package; the result is empty if the package is not installed
    pattern : glob of the adapter files, relative to the package
    suffix : part of the file name after the backend's name, e.g. "_.py" in "osqp_.py"

    """
    spec = find_spec(library)
    roots = (spec.submodule_search_locations if spec else None) or []
    return {
        path.name.removesuffix(suffix): path
        for root in roots
        for path in sorted(Path(root).glob(pattern))
        if path.name.endswith(suffix)
    }


def reason_unavailable(
    library: str, backend: str, files: Mapping[str, Path]
) -> str | None:
    """Return the reason why a backend cannot be used, or None.

    None is also returned if the library itself is not installed, because `prepare` then
    raises ImportError.

    files : result of `adapter_files`
    """
    if not files:
        return None
    missing = _missing_packages(files[backend]) if backend in files else []
    if backend in files and not missing:
        return None
    installed = ", ".join(name for name in files if not _missing_packages(files[name]))
    if missing:
        return f"not installed: {', '.join(missing)}; installed backends: {installed}"
    return f"{library} has no backend {backend!r}; installed: {installed}"


def _missing_packages(adapter: Path) -> list[str]:
    """Return the packages that an adapter file imports but that are not installed."""
    return [root for root in _imported_packages(adapter) if find_spec(root) is None]


@cache
def _imported_packages(adapter: Path) -> tuple[str, ...]:
    """Return the names of the top-level packages that an adapter file imports."""
    roots: dict[str, None] = {}
    for node in ast.walk(ast.parse(adapter.read_text(encoding="utf-8"))):
        match node:
            case ast.Import(names=names):
                roots |= dict.fromkeys(n.name.partition(".")[0] for n in names)
            case ast.ImportFrom(module=str(name), level=0):
                roots[name.partition(".")[0]] = None
    return tuple(roots)
