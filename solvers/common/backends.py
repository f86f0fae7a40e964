"""Which backends a library of solvers knows, found without importing the library.

Importing qpsolvers or cvxpy imports every installed backend, which takes a second.
Their adapter files are there to be listed, and name the modules that they import.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from mortarbench.solvers.common.conversion import OBJECTIVE_SIZE


@dataclass(frozen=True)
class Call:
    """How one backend of a library of solvers is called for a tolerance."""

    tolerances: tuple[str, ...] = ()  #: keywords that get max(tighter·tol, floor)
    fixed: Mapping[str, Any] = field(default_factory=dict)  #: other keywords
    size: float = OBJECTIVE_SIZE  #: ‖q‖∞ that the objective is multiplied to
    tighter: float = 1.0
    floor: float = 0.0

    def options(self, tol: float) -> dict[str, Any]:
        """All keywords with their values."""
        value = max(self.tighter * tol, self.floor)
        return {**dict.fromkeys(self.tolerances, value), **self.fixed}


def adapter_files(library: str, pattern: str, suffix: str) -> dict[str, Path]:
    """Map the name of each backend, as its file spells it, to its adapter's file.

    Parameters
    ----------
    library : an importable package; nothing is found when it is not installed
    pattern : glob of the adapters' files, relative to the package
    suffix : what the names of these files end in, e.g. "_.py" in "osqp_.py"

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
    """Say why a backend cannot be used, or None; `files` as from `adapter_files`.

    A library that is not installed is no reason: importing it will say so.
    """
    if not files:
        return None
    lacking = _missing_packages(files[backend]) if backend in files else []
    if backend in files and not lacking:
        return None
    installed = ", ".join(name for name in files if not _missing_packages(files[name]))
    if lacking:
        return f"not installed: {', '.join(lacking)}; {library} finds {installed}"
    return f"{library} has no backend {backend!r}; installed: {installed}"


def _missing_packages(adapter: Path) -> list[str]:
    """List the top-level packages that an adapter's file imports and we lack."""
    return [root for root in _imported_packages(adapter) if find_spec(root) is None]


@cache
def _imported_packages(adapter: Path) -> tuple[str, ...]:
    """List the top-level packages that an adapter's file imports."""
    roots: dict[str, None] = {}
    for node in ast.walk(ast.parse(adapter.read_text(encoding="utf-8"))):
        match node:
            case ast.Import(names=names):
                roots |= dict.fromkeys(n.name.partition(".")[0] for n in names)
            case ast.ImportFrom(module=str(name), level=0):
                roots[name.partition(".")[0]] = None
    return tuple(roots)
