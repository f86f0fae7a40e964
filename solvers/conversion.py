"""What the adapters of foreign solvers share: matrices in, multipliers out."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_matrix

from harness import QP, Matrix, Vector

NEGLIGIBLE = 1e-14  #: an absolute tolerance where a solver's test adds it to a relative


def needs_matrices(qp: QP) -> str | None:
    """Give the reason to decline a `qp` whose P is an operator, else None."""
    return None if qp.is_explicit else "needs explicit matrices"


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


def on_present_bounds(qp: QP, z_box: Vector) -> Vector:
    """Zero the multipliers (n,) of absent bounds, where solvers leave round-off.

    What is dropped here stays visible to the harness as a stationarity residual.
    """
    z_box = np.where(np.isfinite(qp.lb), z_box, np.maximum(z_box, 0.0))
    return np.where(np.isfinite(qp.ub), z_box, np.minimum(z_box, 0.0))


def positive(**options: float) -> None:
    """Raise ValueError unless every option of a solver is positive."""
    for name, value in options.items():
        if not value > 0:
            raise ValueError(f"{name} = {value}; expected a positive number")
