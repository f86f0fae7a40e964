"""Smoothed aggregation for the linear systems of solvers of sparse QPs.

The hierarchy is the one of pyamg (Vaněk, Mandel and Brezina 1996, Computing 56). In the
primal QP of floating elastic bodies, the kernel of the stiffness matrix P contains the
translations, which smoothed aggregation uses as near-kernel vectors. Rotations are not
used, because a QP contains no coordinates.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array, csr_matrix
from scipy.sparse.linalg import LinearOperator

from mortarbench.harness import QP, Matrix, needs_matrices

#: a translation t counts as an element of the kernel if ‖Pt‖∞ is at most this factor
#: times ‖P‖∞
KERNEL_ROUNDING = 1e-8
#: largest number of unknowns on the coarsest level
COARSEST = 100


def needs_sparse(qp: QP) -> str | None:
    """Return the reason to decline `qp` if P is not a sparse matrix, or None."""
    if (reason := needs_matrices(qp)) is not None:
        return reason
    if isinstance(qp.P, np.ndarray):
        return "P is dense, but multigrid needs a sparse matrix"
    return None


def near_kernel(P: Matrix) -> NDArray[np.float64]:
    """Return translations (n, d) of nodes with d = 3 or 2 components, or ones (n, 1).

    Translations are returned if they are in the kernel of P, as for floating bodies.
    """
    n = P.shape[0]
    scale = KERNEL_ROUNDING * abs(P).sum(axis=1).max() if n else 0.0
    for d in (3, 2):
        if n and n % d == 0:
            kernel = np.tile(np.eye(d), (n // d, 1))
            if np.abs(P @ kernel).max() <= scale:
                return kernel
    return np.ones((n, 1))


def multigrid(
    kernel: NDArray[np.float64],
) -> Callable[[csr_array], LinearOperator]:
    """Return a function that sets up one V-cycle for a positive definite matrix (n, n).

    kernel : near-kernel vectors (n, d); matrices are divided into blocks of d rows

    Raises
    ------
    ImportError
        If pyamg is not installed.

    """
    import pyamg  # imported here because it is optional and slow to import

    d = kernel.shape[1]

    def V_cycle(M: csr_array) -> LinearOperator:
        levels = pyamg.smoothed_aggregation_solver(
            csr_matrix(M) if d == 1 else bsr_array(M, blocksize=(d, d)),
            B=kernel,
            symmetry="symmetric",
            max_coarse=COARSEST,
            coarse_solver="splu",  # the default pseudo-inverse took seconds
        )
        return levels.aspreconditioner()

    return V_cycle
