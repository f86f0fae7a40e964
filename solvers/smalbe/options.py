"""Options of SMALBE."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from mortarbench.harness import QP
from mortarbench.solvers.common.conversion import check_choice, check_positive
from mortarbench.solvers.smalbe.extension import Operator, StepRule
from mortarbench.solvers.smalbe.preconditioner import PRECONDITIONERS, Preconditioner

#: Rule of the expansion step. The number of products with F is in brackets.
#: model: the CG point, projected in the metric of the model (2, or 1 if the step to the
#: boundary is the whole step; 1 more per CG step beyond the box, and 1 more if the
#: decrease is below the decrease of gradient projection)
#: spectral: a step to the boundary and, unless this step is most of the CG step, a
#: projected Barzilai-Borwein step with a nonmonotone line search (1 or 2).
#: Barzilai-Borwein steps also replace every proportioning step, and CG if the first CG
#: step would leave the set (1). With discs, the value model selects spectral, because
#: the model is minimised only over boxes
Expansion = Literal["model", "spectral"]


@dataclass(frozen=True)
class Options:
    """Options of SMALBE."""

    expansion: Expansion = "model"  #: see `solvers.smalbe.options`
    preconditioner: Preconditioner = "auto"  #: see `solvers.smalbe.preconditioner`
    #: penalty ρ, relative to ‖𝒫F𝒫‖; 0 selects 1 with discs, 1e6 if P provides a
    #: preconditioner, else 1e4
    rho: float = 0.0
    M: float = 1.0  #: initial M in units of ‖𝒫F𝒫‖; inner runs end at ‖g^P‖ ≤ M‖Cν‖
    beta: float = 0.5  #: multiplies M if the Lagrangian grows too little
    #: largest ‖g^P‖/‖b‖ at the end of an inner run; CG for a Newton step ends at η²
    eta: float = 0.1
    Gamma: float = 1.0  #: proportioning constant Γ of MPRGP: ‖β‖² > Γ²φ̃ᵀφ
    # if P is sparse, conjugation against stored directions costs more than a product
    recycle: bool = True  #: make CG directions conjugate to all stored ones
    alpha: float = 1.9  #: ᾱ‖H‖ of gradient projection; relaxation factor of model steps
    # n/10 is the limit without equality rows
    lanczos_steps: int = 12  #: limit of Lanczos steps; at most n/6 or n/10, at least 5
    history: bool = False  #: True to record each step
    max_steps: int = 200_000  #: limit of MPRGP steps plus outer iterations

    def __post_init__(self) -> None:
        check_positive(
            M=self.M,
            eta=self.eta,
            Gamma=self.Gamma,
            alpha=self.alpha,
            lanczos_steps=self.lanczos_steps,
            max_steps=self.max_steps,
        )
        if not 0 < self.beta < 1:
            raise ValueError(f"beta = {self.beta}; expected a number between 0 and 1")
        if not 0 <= self.rho < np.inf:
            raise ValueError(f"rho = {self.rho}; expected 0, or a positive number")
        if not self.alpha <= 2:
            raise ValueError(f"alpha = {self.alpha}; expected at most 2")
        choices = {
            "expansion": get_args(Expansion),
            "preconditioner": PRECONDITIONERS,
        }
        for name, known in choices.items():
            check_choice(name, getattr(self, name), known)
        if self.is_extended and self.preconditioner == "incomplete":
            raise ValueError(
                "preconditioner = 'incomplete' replaces the functions of a subclass; "
                "expected another one"
            )

    def preconditioner_for(self, qp: QP) -> Operator | None:
        """Return v ↦ Mv for this QP, or None to use the option `preconditioner`.

        Subclasses may override this method (`solvers.smalbe.extension`). M approximates
        P⁻¹ and must be symmetric positive definite. SMALBE restricts M to the face.
        """
        return None

    def step_rule_for(self, qp: QP) -> StepRule | None:
        """Return a step rule for this QP, or None to use the option `expansion`.

        Subclasses may override this method (`solvers.smalbe.extension`). Whenever a CG
        step would leave the box, SMALBE calls the rule for a trial point.
        """
        return None

    @property
    def is_extended(self) -> bool:
        """True for a subclass that defines its own preconditioner or step rule."""
        own = type(self)
        return (
            own.preconditioner_for is not Options.preconditioner_for
            or own.step_rule_for is not Options.step_rule_for
        )
