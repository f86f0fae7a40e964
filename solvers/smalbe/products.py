"""Products with the matrix of a QP."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsymv

from harness import Matrix, Vector


def product(P: Matrix) -> Callable[[Vector], Vector]:
    """Return v → Pv for a symmetric P; of a dense one only a triangle is read.

    Memory bounds a product with a dense matrix: half of it takes about half the time.
    """
    rows = dense_rows(P)
    if rows is None:
        return lambda v: np.asarray(P @ v)
    columns = rows.T
    return lambda v: np.asarray(dsymv(1.0, columns, v, lower=1))


def dense_rows(P: Matrix) -> NDArray[np.float64] | None:
    """Return a dense symmetric P with contiguous rows, None if it is no such array."""
    if not isinstance(P, np.ndarray) or P.dtype != np.float64 or not P.size:
        return None
    return next((M for M in (P, P.T) if M.flags.c_contiguous), None)
