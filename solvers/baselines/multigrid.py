"""Smoothed aggregation for the linear systems of solvers of sparse QPs.

The hierarchy is the one of pyamg (Vaněk, Mandel and Brezina 1996, Computing 56). In the
primal QP of floating elastic bodies, the kernel of the stiffness matrix P contains the
translations, which smoothed aggregation uses as near-kernel vectors. Rotations are not
used, because a QP contains no coordinates.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array, csr_matrix, diags_array
from scipy.sparse.linalg import LinearOperator, cg

from mortarbench.harness import QP, Matrix, Vector, needs_matrices
from mortarbench.solvers.baselines.face import InnerSolveError, Mask, Solve

#: a translation t counts as an element of the kernel if ‖Pt‖∞ is at most this factor
#: times ‖P‖∞
KERNEL_ROUNDING = 1e-8
#: largest number of unknowns on the coarsest level
COARSEST = 100
MAX_CG = 1000  #: largest number of CG steps per solve; contact cases need 5 to 80


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


def on_free(H: Matrix, free: Mask, diagonal: Vector) -> csr_array:
    """Return the matrix H (n, n) on the free components.

    Other components keep uncoupled rows with entries `diagonal` (n,), so that every
    node keeps its block.
    """
    mask = diags_array(1.0 * free)
    return csr_array(mask @ H @ mask + diags_array(np.where(free, 0.0, diagonal)))


def cg_on_free(
    H: csr_array,
    free: Mask,
    precondition: LinearOperator,
    counts: Counter[str],
    *,
    rtol: float,
    atol: float = 0.0,
) -> Solve:
    """Return r (n,) ↦ H⁻¹r by preconditioned CG; zero where components are not free.

    H : result of `on_free`
    counts : its entry "cg" is increased by the number of steps
    rtol, atol : CG ends at a residual of at most max(rtol·‖r‖, atol)

    The returned function raises `InnerSolveError` after `MAX_CG` steps.
    """

    def count(_: object) -> None:
        counts["cg"] += 1

    def solve(r: Vector) -> Vector:
        dx, failed = cg(
            H,
            np.where(free, r, 0.0),
            rtol=rtol,
            atol=atol,
            maxiter=MAX_CG,
            M=precondition,
            callback=count,
        )
        if failed:
            raise InnerSolveError(f"no convergence in {MAX_CG} steps of CG")
        return np.where(free, dx, 0.0)

    return solve
