"""Primal-dual active set method with algebraic multigrid instead of Cholesky factors.

The outer iteration is the one of `solvers.baselines.pdas`. On each face, the Newton
system is solved by conjugate gradients, preconditioned by smoothed aggregation (Vaněk,
Mandel and Brezina 1996, Computing 56; pyamg). In the primal QP of floating elastic
bodies, the kernel of the stiffness matrix P contains the translations, which smoothed
aggregation uses as near-kernel vectors. Rotations are not used, because a QP contains
no coordinates.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array, csr_matrix, diags_array
from scipy.sparse.linalg import cg

from mortarbench.harness import QP, About, Matrix, Solution, Vector, needs_matrices
from mortarbench.solvers.baselines.face import (
    Faces,
    Factorise,
    InnerSolveError,
    Mask,
    Solve,
)
from mortarbench.solvers.baselines.pdas import PDAS, Carry

#: a translation t counts as an element of the kernel if ‖Pt‖∞ is at most this factor
#: times ‖P‖∞
KERNEL_ROUNDING = 1e-8
#: Relative residual of conjugate gradients, divided by the tolerance of the QP. With
#: 1e-3 instead, the number of solves did not change (13 on beam-ring, 6 on
#: cube-wall/n=16), but 17 to 34 % more CG steps were necessary.
CG_SHARE = 0.1
#: largest number of CG steps per solve; small beam-ring and cube-wall cases need 9 to
#: 80 steps
MAX_CG = 1000
#: largest number of unknowns on the coarsest level
COARSEST = 100


@dataclass(frozen=True)
class PDASAMG(PDAS):
    """`pdas` with conjugate gradients and algebraic multigrid on the faces.

    P must be sparse. If the translations are in the kernel of P, the near-kernel
    consists of the translations, otherwise of a constant vector. The solver reports the
    same counts as `pdas`, where a multigrid setup counts as a factorisation, and the
    number of conjugate-gradient steps.
    """

    about: ClassVar[About] = About(
        title="PDAS with multigrid (ours)",
        licence="BSD-3-Clause",
        method="primal-dual active set, in a proximal method of multipliers",
        linear_solver="conjugate gradients, preconditioned by smoothed aggregation "
        "(pyamg)",
        phases="assembly of the penalised matrix (preparing); multigrid setup for "
        "each face and iterations (solving)",
        sequence="starts from the last active set and point",
        package="pyamg",
        limits=(
            "The near-kernel does not contain rotations, because a QP contains no "
            "coordinates.",
            "More CG steps are needed if rows couple several nodes: 30 to 80 steps "
            "per solve on beam-ring, but 9 to 22 on cube-wall.",
        ),
    )

    def declines(self, qp: QP) -> str | None:
        if (reason := needs_matrices(qp)) is not None:
            return reason
        if isinstance(qp.P, np.ndarray):
            return "P is dense, but multigrid needs a sparse matrix"
        return None

    def _set_up(
        self, qp: QP, tol: float, carry: Carry | None
    ) -> Callable[[], tuple[Solution, Carry | None]]:
        run = super()._set_up(qp, tol, carry)

        def reporting() -> tuple[Solution, Carry | None]:
            solution, carried = run()
            name = {"linear_solver": "smoothed aggregation (pyamg)"}
            return replace(solution, reported={**solution.reported, **name}), carried

        return reporting

    def faces(self, qp: QP, tol: float, counts: Counter[str]) -> Factorise:
        kernel, rtol = _near_kernel(qp.P), CG_SHARE * tol

        def make(M: Matrix, G: Matrix, rho: Vector, always_free: Mask) -> Faces:
            del always_free
            return _multigrid(csr_array(M), csr_array(G), rho, kernel, rtol, counts)

        return make


def _near_kernel(P: Matrix) -> NDArray[np.float64]:
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


def _multigrid(
    M: csr_array,
    G: csr_array,
    rho: Vector,
    kernel: NDArray[np.float64],
    rtol: float,
    counts: Counter[str],
) -> Faces:
    import pyamg  # imported here because it is optional and slow to import

    d = kernel.shape[1]

    def face(free: Mask, active: Mask) -> Solve:
        F = M + G[active].T @ (diags_array(rho[active]) @ G[active])
        # keep fixed components as uncoupled rows, so that every node keeps d rows
        inside = diags_array(1.0 * free)
        F = inside @ F @ inside + diags_array(np.where(free, 0.0, M.diagonal()))
        levels = pyamg.smoothed_aggregation_solver(
            csr_matrix(F) if d == 1 else bsr_array(F, blocksize=(d, d)),
            B=kernel,
            symmetry="symmetric",
            max_coarse=COARSEST,
            coarse_solver="splu",  # the default pseudo-inverse took seconds
        )
        precondition = levels.aspreconditioner()

        def step(_: object) -> None:
            counts["cg"] += 1

        def solve(r: Vector) -> Vector:
            b = np.where(free, r, 0.0)
            dx, failed = cg(
                F, b, rtol=rtol, maxiter=MAX_CG, M=precondition, callback=step
            )
            if failed:
                raise InnerSolveError(f"no convergence in {MAX_CG} steps of CG")
            return np.asarray(np.where(free, dx, 0.0))

        return solve

    return face
