"""What the adapters of foreign solvers share: matrices in, multipliers out."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, eye_array, vstack

from mortarbench.harness import QP, Matrix, Solution, Vector, needs_matrices, too_large
from mortarbench.harness.sets.convex import admissible

NEGLIGIBLE = 1e-14  #: an absolute tolerance where a solver's test adds it to a relative
DIVERGED = 1e12  #: an ‖x‖∞ beyond which relative residuals mean nothing
OBJECTIVE_SIZE = 1e4  #: ‖q‖∞ as handed to solvers that compare with max(1, objective)


def needs_dense(qp: QP, copies: float) -> str | None:
    """Give the reason to decline a `qp` whose dense matrices do not fit, else None.

    copies : how many matrices of P's size the solver holds at a time
    """
    return needs_matrices(qp) or too_large(qp.q.size, copies)


def needs_independent_rows(qp: QP) -> str | None:
    """Give the reason to decline a `qp` with dependent equality rows, else None.

    By the rank of AAᵀ, so rows that are dependent to half of the digits count.
    """
    gram = dense(csc(qp.A) @ csc(qp.A).T)
    if not gram.size or np.linalg.matrix_rank(gram, hermitian=True) == len(gram):
        return None
    return "the equality rows depend on each other"


def csc(M: Matrix) -> csc_matrix:
    """Copy a dense or sparse matrix to a writable CSC matrix with sorted indices.

    Solvers get a csc_matrix, not a csc_array: OSQP warns about the latter and
    qpsolvers takes it for dense.
    """
    copy = csc_matrix(M, dtype=np.float64, copy=True)
    copy.sum_duplicates()
    return copy


def dense(M: Matrix) -> Vector:
    """Copy a dense or sparse matrix to a dense array."""
    return np.array(M.toarray() if hasattr(M, "toarray") else M, dtype=np.float64)


def resolve_backend(backend: str, qp: QP) -> str:
    """Choose between "dense" and "sparse", as P is stored, where `backend` is auto."""
    if backend != "auto":
        return backend
    return "dense" if isinstance(qp.P, np.ndarray) else "sparse"


def has_bound(qp: QP) -> NDArray[np.bool_]:
    """Mark the variables that have a bound."""
    return np.isfinite(qp.lb) | np.isfinite(qp.ub)


def two_sided(qp: QP) -> tuple[csc_matrix, Vector, Vector]:
    """Give all constraints as low ≤ Rx ≤ high: A, G, then rows of bounded variables."""
    box = has_bound(qp)
    rows = vstack([csc(qp.A), csc(qp.G), eye_array(qp.q.size, format="csr")[box]])
    low = np.concatenate([qp.b, np.full(qp.h.size, -np.inf), qp.lb[box]])
    return csc(rows), low, np.concatenate([qp.b, qp.h, qp.ub[box]])


def from_two_sided(qp: QP, v: Vector) -> dict[str, Any]:
    """Split the multipliers of `two_sided` rows, ≥ 0 at `high`, into y, z and z_box."""
    m, p = qp.b.size, qp.h.size
    z_box = np.zeros(qp.q.size)
    z_box[has_bound(qp)] = v[m + p :]
    return {
        "y": np.array(v[:m]),
        "z": np.array(v[m : m + p]),
        "z_box": on_present_bounds(qp, z_box),
    }


def to_two_sided(qp: QP, s: Solution) -> Vector:
    """Stack the multipliers of a point as `from_two_sided` takes them apart."""
    return np.concatenate([s.y, s.z, s.z_box[has_bound(qp)]])


def one_sided(qp: QP) -> tuple[csc_matrix, Vector]:
    """Give all constraints as Rx ≤ r, A (equal), G, then finite ub, then finite −lb."""
    up, low = np.isfinite(qp.ub), np.isfinite(qp.lb)
    eye = eye_array(qp.q.size, format="csr")
    rows = vstack([csc(qp.A), csc(qp.G), eye[up], -eye[low]])
    return csc(rows), np.concatenate([qp.b, qp.h, qp.ub[up], -qp.lb[low]])


def from_one_sided(qp: QP, v: Vector) -> dict[str, Any]:
    """Split the multipliers of `one_sided` rows into y, z and z_box."""
    m, p = qp.b.size, qp.h.size
    up, low = np.isfinite(qp.ub), np.isfinite(qp.lb)
    z_up, z_low = np.split(v[m + p :], [up.sum()])
    z_box = np.zeros(qp.q.size)
    z_box[up] += z_up
    z_box[low] -= z_low
    return {
        "y": np.array(v[:m]),
        "z": np.array(v[m : m + p]),
        "z_box": on_present_bounds(qp, z_box),
    }


def to_one_sided(qp: QP, s: Solution) -> Vector:
    """Stack the multipliers of a point as `from_one_sided` takes them apart."""
    up, low = np.isfinite(qp.ub), np.isfinite(qp.lb)
    z_up, z_low = np.maximum(s.z_box[up], 0), np.maximum(-s.z_box[low], 0)
    return np.concatenate([s.y, s.z, z_up, z_low])


def conic_point(qp: QP, s: Solution) -> tuple[Vector, Vector, Vector]:
    """Return x, the multipliers and the slack max(r − Rx, 0) of `one_sided` rows."""
    rows, rhs = one_sided(qp)
    return s.x.copy(), to_one_sided(qp, s), np.maximum(rhs - rows @ s.x, 0.0)


def objective_factor(qp: QP, size: float = OBJECTIVE_SIZE) -> float:
    """Give the factor of the objective that makes ‖q‖∞ equal to `size`."""
    return float(size / (np.abs(qp.q).max(initial=0.0) or size))


def on_present_bounds(qp: QP, z_box: Vector) -> Vector:
    """Zero multipliers (n,) that no bound or set bears, where solvers leave round-off.

    What is dropped here stays visible to the harness as a stationarity residual.
    """
    return admissible(qp.sets, z_box)


def check_choice(name: str, value: Any, allowed: tuple[Any, ...]) -> None:
    """Raise ValueError unless the value of an option is one of those allowed."""
    if value not in allowed:
        choices = ", ".join(map(repr, allowed[:-1]))
        raise ValueError(f"{name} = {value!r}; expected {choices} or {allowed[-1]!r}")


def check_positive(**options: float) -> None:
    """Raise ValueError unless every option of a solver is positive and finite."""
    for name, value in options.items():
        if not 0 < value < np.inf:
            raise ValueError(f"{name} = {value}; expected a finite positive number")
