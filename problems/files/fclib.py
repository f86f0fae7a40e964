"""FCLIB files: contact problems with Coulomb friction, stored in HDF5.

The unknowns of a local problem are the contact forces r, in blocks of one normal and
one or two tangential components, and multipliers l of equality constraints; u are the
relative velocities at the contacts. Global problems also have the velocities v of the
bodies as unknowns::

    u = W r + V l + q,   Vᵀr + R l + s = 0                        (local)
    M v = H r + G l + f,   Gᵀv + b = 0,   u = Hᵀv + w             (global)

In both forms, r is in the friction cone K, û = u + (μ‖u_T‖, 0) is in the dual cone of
K, and r is orthogonal to û.

A matrix is a group with the members nzmax, m, n, nz, p, i and x. The matrix is stored
by columns if nz = −1, by rows if nz = −2, and as nz triplets otherwise. According to
the documentation of FCLIB, p contains the row indices of triplets, but files written by
Siconos follow CSparse, where p contains the column indices. Both conventions are
supported. If the indices fit the shape of the matrix under both conventions, the
convention of CSparse is used.

Reference: V. Acary et al., FCLIB: a library of frictional contact problems,
https://frictionalcontactlibrary.github.io.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_array, coo_array, csc_array, csr_array
from scipy.sparse.linalg import splu

from mortarbench.harness import InputError, Vector
from mortarbench.harness.checked import located
from mortarbench.harness.files.reading import check_size
from mortarbench.problems.fem.mesh_files.hdf5 import opened_hdf5
from mortarbench.problems.files.friction_cones import FrictionalContact

SUFFIX = ".hdf5"
_KINDS = ("fclib_local", "fclib_global")
_COLUMNS, _ROWS = -1, -2  #: values of nz for compressed matrices

#: mapping from an HDF5 path to the array of a file
Datasets = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class FclibFile:
    """Contact problem of an FCLIB file, with its solution if the file contains one."""

    contact: FrictionalContact
    stored: Vector | None  #: (n,) forces of /solution; None if the file has no solution
    #: (p,) multipliers of /solution; zeros if the file does not contain them
    multipliers: Vector


def read_fclib(path: Path) -> FclibFile:
    """Read an FCLIB file, and reduce a global problem to a local one.

    Raises
    ------
    InputError
        If the file is damaged or contains rolling friction, or if W is not symmetric.

    """
    with opened_hdf5(path, "an FCLIB file", 2) as nodes:
        datasets = {k: node for k, node in nodes.items() if hasattr(node, "dtype")}
        arrays = {name: np.asarray(node[()]) for name, node in datasets.items()}
    with located(str(path)):
        return to_contact(arrays)


def to_contact(arrays: Datasets) -> FclibFile:
    """Return the contact problem that the arrays of a file define.

    Raises
    ------
    InputError
        If an array is missing or inconsistent with other arrays, or if the type of
        problem is not supported.

    """
    kinds = [
        kind for kind in _KINDS if any(name.startswith(f"{kind}/") for name in arrays)
    ]
    if any("rolling" in name or name.endswith("/mu_r") for name in arrays):
        raise InputError(
            "rolling friction is not supported; expected fclib_local or fclib_global "
            "without mu_r"
        )
    if len(kinds) != 1:
        raise InputError(
            "no FCLIB problem; expected one group fclib_local or fclib_global"
        )
    part = _Group(kinds[0], arrays)
    dim, mu = part.integer("spacedim"), part.vector("vectors/mu")
    if dim not in (2, 3):
        raise InputError(f"spacedim is {dim}; expected 2 or 3")
    if (mu < 0).any():
        raise InputError(f"vectors/mu contains {mu.min():g}; expected only numbers ≥ 0")
    local = _local if kinds[0] == "fclib_local" else _global
    contact = local(part, dim * mu.size, mu)
    solution = _Group("solution", arrays)
    stored = solution.vector("r", contact.q.size) if solution.has("r") else None
    p = contact.b.size
    has_multipliers = stored is not None and solution.has("l") and p > 0
    multipliers = solution.vector("l", p) if has_multipliers else np.zeros(p)
    return FclibFile(contact, stored, multipliers)


def _local(part: _Group, n: int, mu: Vector) -> FrictionalContact:
    W, q = part.matrix("W", n, n), part.vector("vectors/q", n)
    if not part.has("V/x"):
        return FrictionalContact(W=W, q=q, mu=mu)
    s = part.vector("vectors/s")
    V, R = part.matrix("V", n, s.size), part.matrix("R", s.size, s.size)
    if not R.nnz or not np.abs(R.data).max():
        return FrictionalContact(W=W, q=q, mu=mu, A=csr_array(V.T), b=-s)
    eliminated = _factor("R", R).solve(np.column_stack([V.T.toarray(), s]))
    W = csc_array(W - V @ csc_array(eliminated[:, :-1]))
    return FrictionalContact(W=W, q=q - V @ eliminated[:, -1], mu=mu)


def _global(part: _Group, n: int, mu: Vector) -> FrictionalContact:
    """Return the local form of a global problem, with v and l eliminated."""
    f, w = part.vector("vectors/f"), part.vector("vectors/w", n)
    M, H = part.matrix("M", f.size, f.size), part.matrix("H", f.size, n)
    check_size("W, a dense matrix", 8 * (n + f.size) * n)
    rows, rhs, K = H.toarray(), f, M
    if part.has("G/x"):
        b = part.vector("vectors/b")
        G = part.matrix("G", f.size, b.size)
        K = csc_array(block_array([[M, -G], [-G.T, None]]))
        rows, rhs = np.vstack([rows, np.zeros((b.size, n))]), np.append(f, b)
    solved = _factor("M", K).solve(np.column_stack([rows, rhs]))[: f.size]
    W = csc_array(H.T @ solved[:, :-1])
    return FrictionalContact(W=W, q=H.T @ solved[:, -1] + w, mu=mu)


def _factor(name: str, K: Any) -> Any:
    try:
        return splu(csc_array(K))
    except RuntimeError:
        raise InputError(f"{name} is singular; expected a nonsingular matrix") from None


class _Group:
    """Arrays in one group of a file, validated on access."""

    def __init__(self, name: str, arrays: Datasets) -> None:
        self.name, self._arrays = name, arrays

    def has(self, name: str) -> bool:
        return f"{self.name}/{name}" in self._arrays

    def _array(self, name: str) -> NDArray[Any]:
        if not self.has(name):
            raise InputError(f"{self.name}/{name} is missing; expected an FCLIB file")
        array = self._arrays[f"{self.name}/{name}"]
        if array.dtype.kind not in "iuf":
            raise InputError(f"{self.name}/{name} is not numeric")
        return array.ravel()

    def integer(self, name: str) -> int:
        array = self._array(name)
        if array.size != 1 or array[0] != int(array[0]):
            raise InputError(f"{self.name}/{name} is not an integer")
        return int(array[0])

    def vector(self, name: str, size: int | None = None) -> Vector:
        vector: Vector = self._array(name).astype(float)
        if size is not None and vector.size != size:
            raise InputError(
                f"{self.name}/{name} has {vector.size} entries; expected {size}"
            )
        if not np.isfinite(vector).all():
            raise InputError(f"{self.name}/{name} contains NaN or inf")
        return vector

    def matrix(self, name: str, m: int, n: int) -> csc_array:
        """Return a matrix; raise InputError unless its shape is (m, n)."""
        nz, *shape = (self.integer(f"{name}/{key}") for key in ("nz", "m", "n"))
        if shape != [m, n]:
            raise InputError(
                f"{self.name}/{name} has shape {tuple(shape)}; expected {(m, n)}"
            )
        x = self.vector(f"{name}/x")
        p, i = (self._array(f"{name}/{key}").astype(np.int64) for key in "pi")
        try:
            if nz in (_COLUMNS, _ROWS):
                kind = csc_array if nz == _COLUMNS else csr_array
                matrix = kind((x[: p[-1]], i[: p[-1]], p), shape=(m, n))
                matrix.check_format()
                return csc_array(matrix)
            if not nz <= min(p.size, i.size, x.size) or nz < 0:
                raise ValueError("fewer entries than nz")
            places = (i[:nz], p[:nz])
            if max(places[0], default=0) >= m or max(places[1], default=0) >= n:
                places = (p[:nz], i[:nz])
            return csc_array(coo_array((x[:nz], places), shape=(m, n)))
        except (ValueError, IndexError):
            raise InputError(
                f"{self.name}/{name} is not a matrix: its p, i and x do not fit "
                f"{m} rows and {n} columns"
            ) from None
