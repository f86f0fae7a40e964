"""SMALBE: semimonotonic augmented Lagrangians for bounds and equalities.

Minimises ½xᵀFx − dᵀx subject to Gx = e and l ≤ x ≤ u (Dostál 2009, the paper's
reference [3], Chapter 6; equation (2) of the paper).

1. C: orthonormal rows that span those of G; e is transformed with them.
2. Homogenise: x = x̃ + ν with x̃ = Cᵀe, so that Cν = 0 and l − x̃ ≤ ν ≤ u − x̃.
3. Project with Q = CᵀC, 𝒫 = I − Q, and normalise by ‖𝒫F𝒫‖ (Lanczos):
   H = 𝒫F𝒫/‖𝒫F𝒫‖ + ρQ,   b = 𝒫(d − Fx̃)/‖𝒫F𝒫‖.
4. The outer loop (outer.pxi) over MPRGP (mprgp.pxi). Without equalities one run of
   MPRGP is left.

What is ours: the Lanczos process that finds the norm finds the upper Ritz pairs too.
With them and with C it gives a model of H (model.pxi), which serves three times: for
steps that change the face, as preconditioner in the face, and to make a large ρ
harmless. The presets are the methods as others run them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from mortarbench.harness import QP, About, Solution
from mortarbench.solvers.smalbe.driver import Carry, prepared
from mortarbench.solvers.smalbe.options import Options
from mortarbench.solvers.smalbe.preconditioner import lacking


@dataclass(frozen=True)
class SMALBE(Options):
    """In-house SMALBE with MPRGP for bounds and equalities; needs only products with P.

    `tol` bounds ‖g^P‖/‖b‖ and ‖Gx − e‖/‖e‖ of the projected problem. A point is claimed
    solved only if its KKT residuals on the original problem are within 5·tol as well.
    """

    about: ClassVar[About] = About(
        title="SMALBE (ours)", licence="BSD-3-Clause",
        method="augmented Lagrangian with an active-set method inside (MPRGP)",
        linear_solver="none: products with P, small dense systems of its model, "
        "incomplete factors of a sparse P",
        phases="preparing orthonormalises rows and runs the Lanczos process",
        sequence="point, multipliers, Ritz pairs, factor of the free block",
        limits=(
            "inequality rows are declined; the dual forms of a problem have none",
            "of 2100 hostile random QPs (ill-conditioned, degenerate, with nearly "
            "parallel rows, tolerances to 1e-12) 3 ended as `iteration_limit`",
        ),
    )  # fmt: skip

    on_ranks: ClassVar[bool] = True  #: see `harness.processes.ranks`

    def declines(self, qp: QP) -> str | None:
        if qp.h.size:
            return "takes bounds and equality rows, no inequality rows"
        return lacking(qp, self.preconditioner)

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        solve = prepared(qp, tol, self, None, eliminate=self.eliminate == "always")
        return lambda: solve()[0]

    def chain(self, tol: float) -> Callable[[QP], Callable[[], Solution]]:
        prepare = self.tightening()
        return lambda qp: prepare(qp, tol)

    def tightening(self) -> Callable[[QP, float], Callable[[], Solution]]:
        """Begin a sequence, warm: with points, multipliers, Ritz pairs and factors."""
        carry: Carry | None = None

        def prepare(qp: QP, tol: float) -> Callable[[], Solution]:
            eliminate = self.eliminate != "never"
            solve = prepared(qp, tol, self, carry, eliminate=eliminate)

            def run() -> Solution:
                nonlocal carry
                solution, left = solve()
                carry = left()
                return solution

            return run

        return prepare


#: PERMON's constants and step rules (notes in docs/performance.md): MPRGP with its
#: standard expansion and ᾱ = 2/‖H‖ from the power method, ρ = 1.1‖F‖, M = 100‖F‖
PERMON = SMALBE(
    expansion="std", proportioning="cg", preconditioner="none", rho=1.1, M=100.0,
    reduced=False, alpha=2.0, norm="power", eliminate="never", energy=0.0,
    recycle=False,
)  # fmt: skip

#: ESPRESO's: projected CG steps with a check of the cost, gradient projection as
#: proportioning, everything relative to ‖𝒫F𝒫‖
ESPRESO = SMALBE(
    expansion="mixed", proportioning="model", preconditioner="none", rho=1.0,
    beta=0.8, eta=1.0, alpha=2.0, norm="power", eliminate="never", energy=0.0,
    recycle=False,
)  # fmt: skip

#: the textbook's (the paper's reference [3]): Γ = 1, reduced free gradient, fixed ᾱ
PAPER = SMALBE(
    expansion="std", proportioning="cg", preconditioner="none", rho=1.0,
    eliminate="never", energy=0.0, recycle=False,
)  # fmt: skip

CONDENSED = SMALBE(eliminate="always")
