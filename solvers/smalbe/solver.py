"""SMALBE: semimonotonic augmented Lagrangians for bounds, discs and equalities.

The method minimises ½xᵀFx − dᵀx subject to Gx = e, l ≤ x ≤ u, and ‖x_I‖ ≤ r on discs
(Dostál 2009, the paper's reference [3], Chapter 6; equation (2) of the paper, without
discs). With discs, the inner loop is MPGP (Dostál and Pospíšil 2016, the paper's
reference [12]; Bouchala, Dostál, Kozubek, Pospíšil and Vodstrčil), by default with
spectral steps (mprgp.pxi).

1. Compute orthonormal rows C with the span of the rows of G; transform e accordingly.
2. Homogenise: x = x̃ + ν with x̃ = Cᵀe, so that Cν = 0 and l − x̃ ≤ ν ≤ u − x̃.
3. Project with Q = CᵀC, 𝒫 = I − Q, and normalise by ‖𝒫F𝒫‖ (Lanczos):
   H = 𝒫F𝒫/‖𝒫F𝒫‖ + ρQ,   b = 𝒫(d − Fx̃)/‖𝒫F𝒫‖.
4. Run the outer loop (outer.pxi) with MPRGP (mprgp.pxi) as the inner loop. Without
   equality rows, the outer loop consists of a single run of MPRGP.

One part of this implementation is new: the Lanczos process that estimates the norm also
yields the upper Ritz pairs. These pairs and C define a model of H (model.pxi). The
model determines the steps that change the face, preconditions CG on the face, and
permits a large ρ without loss of conditioning. `solvers.smalbe.textbook` contains the
published algorithms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from mortarbench.harness import QP, About, Box, Discs, Solution
from mortarbench.solvers.smalbe.driver import Carry, prepared
from mortarbench.solvers.smalbe.options import Options
from mortarbench.solvers.smalbe.preconditioner import missing_data


@dataclass(frozen=True)
class SMALBE(Options):
    """In-house SMALBE with MPRGP for bounds and equality rows.

    SMALBE needs only products with P. It also accepts discs, which bound friction
    forces in three dimensions.

    The solver stops when the relative KKT residual of the QP is at most tol.
    """

    about: ClassVar[About] = About(
        title="SMALBE (ours)",
        licence="BSD-3-Clause",
        method="augmented Lagrangian with an inner active-set method (MPRGP)",
        linear_solver="none (products with P, small dense systems of the model, "
        "incomplete factors of a sparse P)",
        phases="orthonormalisation of rows and Lanczos process (preparing); iterations "
        "(solving)",
        sequence="reuses the point, multipliers and Ritz pairs",
        limits=(
            "QPs with inequality rows are declined; dual forms have no inequality "
            "rows.",
            "In a test with 2100 difficult random QPs (ill-conditioned, degenerate, "
            "with nearly parallel rows, tolerances down to 1e-12), one solve ended "
            "with `iteration_limit`.",
        ),
    )

    accepts: ClassVar[tuple[type, ...]] = (Box, Discs)

    def declines(self, qp: QP) -> str | None:
        if qp.h.size:
            return "accepts bounds and equality rows, but no inequality rows"
        return missing_data(qp, self.preconditioner)

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        solve = prepared(qp, tol, self, None)
        return lambda: solve()[0]

    def chain(self, tol: float) -> Callable[[QP], Callable[[], Solution]]:
        """Start a sequence in which each solve reuses results of the previous one.

        The reused results are the point, the multipliers and the Ritz pairs.
        """
        carry: Carry | None = None

        def prepare(qp: QP) -> Callable[[], Solution]:
            solve = prepared(qp, tol, self, carry)

            def run() -> Solution:
                nonlocal carry
                solution, carry = solve()
                return solution

            return run

        return prepare
