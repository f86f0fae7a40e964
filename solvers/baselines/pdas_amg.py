"""Primal-dual active set method with algebraic multigrid instead of Cholesky factors.

The outer iteration is the one of `solvers.baselines.pdas`. On each face, the Newton
system is solved by conjugate gradients with the preconditioner of
`solvers.baselines.multigrid`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import LinearOperator

from mortarbench.harness import QP, About, Matrix, Solution, Vector
from mortarbench.solvers.baselines.face import (
    Faces,
    Factorise,
    Mask,
    Solve,
)
from mortarbench.solvers.baselines.multigrid import (
    cg_on_free,
    multigrid,
    near_kernel,
    needs_sparse,
    on_free,
)
from mortarbench.solvers.baselines.pdas import PDAS, Carry

#: Relative residual of conjugate gradients, divided by the tolerance of the QP. With
#: 1e-3 instead, the number of solves did not change (13 on beam-ring, 6 on
#: cube-wall/n=16), but 17 to 34 % more CG steps were necessary.
CG_SHARE = 0.1


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
        return needs_sparse(qp)

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
        V_cycle, rtol = multigrid(near_kernel(qp.P)), CG_SHARE * tol

        def make(M: Matrix, G: Matrix, rho: Vector, always_free: Mask) -> Faces:
            del always_free
            return _multigrid(csr_array(M), csr_array(G), rho, V_cycle, rtol, counts)

        return make


def _multigrid(
    M: csr_array,
    G: csr_array,
    rho: Vector,
    V_cycle: Callable[[csr_array], LinearOperator],
    rtol: float,
    counts: Counter[str],
) -> Faces:
    def face(free: Mask, active: Mask) -> Solve:
        F = M + G[active].T @ (diags_array(rho[active]) @ G[active])
        F = on_free(F, free, M.diagonal())
        return cg_on_free(F, free, V_cycle(F), counts, rtol=rtol)

    return face
