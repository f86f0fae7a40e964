"""Products with the matrix of a QP."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg.blas import dsymv

from harness import Matrix, Vector


def product(P: Matrix) -> Callable[[Vector], Vector]:
    """Return v → Pv for a symmetric P; of a dense one only a triangle is read.

    Memory bounds a product with a dense matrix: half of it takes about half the time.
    """
    if isinstance(P, np.ndarray) and P.dtype == np.float64 and P.size:
        columns = P if P.flags.f_contiguous else P.T
        if columns.flags.f_contiguous:
            return lambda v: np.asarray(dsymv(1.0, columns, v, lower=1))
    return lambda v: np.asarray(P @ v)
