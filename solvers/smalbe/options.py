"""The options of SMALBE."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from mortarbench.solvers.common.conversion import positive
from mortarbench.solvers.smalbe.preconditioner import PRECONDITIONERS, Preconditioner

#: std: the CG step as far as it is feasible, then x ← x − ᾱφ̃ (the book's; 2 products)
#: projcg: x ← P(x − α_cg p), whatever the cost (PERMON's; 2 products)
#: mixed: projcg; where it raised the cost, std (ESPRESO's; 2 or 3 products)
#: model: where CG leads, projected in the metric of the model (ours; 2 products, 1
#: where the CG step as far as it is feasible was all; one for each step beyond the box,
#: one more where it gained less than gradient projection must)
Expansion = Literal["std", "projcg", "mixed", "model"]
#: cg: minimise along −β, as far as feasible (the book's; 1 product)
#: model: a step of the model; for B = I/ᾱ a projected gradient step (1 product); else
#: cg where from one to the next twice in a row ‖β‖² was not halved
Proportioning = Literal["cg", "model"]
EXPANSIONS, PROPORTIONINGS = get_args(Expansion), get_args(Proportioning)
Norm = Literal["lanczos", "power"]
Eliminate = Literal["never", "sequences", "always"]


@dataclass(frozen=True)
class Options:
    """What one can choose."""

    expansion: Expansion = "model"  #: see `solvers.smalbe.options`
    proportioning: Proportioning = "model"
    preconditioner: Preconditioner = "auto"  #: see `solvers.smalbe.preconditioner`
    #: penalty ρ, relative to ‖𝒫F𝒫‖; 0: 1e4, and 1e6 where P offers a preconditioner
    rho: float = 0.0
    rho_growth: float = 1.0  #: factor of ρ where the Lagrangian grew too little
    M: float = 1.0  #: precision of the inner runs at the start, relative to ‖𝒫F𝒫‖
    beta: float = 0.5  #: factor of M where the Lagrangian grew too little
    eta: float = 0.1  #: largest ‖g^P‖/‖b‖ at which an inner run may end
    Gamma: float = 1.0  #: proportioning constant Γ of MPRGP
    # after multiplier steps, too; where P is sparse, a product costs less
    recycle: bool = True  #: CG conjugate to all its directions on a face; P not sparse
    reduced: bool = True  #: proportioning compares β with φ̃ᵀφ, not with φᵀφ
    alpha: float = 1.9  #: ᾱ‖H‖ of gradient projection steps; relaxation of the model's
    norm: Norm = "lanczos"  #: what finds ‖𝒫F𝒫‖
    lanczos_steps: int = (
        12  #: products spent on it; at most n/6 (n/10 without rows), or 5
    )
    # only with the preconditioners model and none: the others need all of P
    eliminate: Eliminate = "sequences"  #: when free variables go by a Cholesky factor
    energy: float = 50.0  #: estimated energy error/tol to reach, too; 0: whatever
    history: bool = False  #: keep a row per step
    max_steps: int = 200_000  #: of MPRGP and outer iterations, in total

    def __post_init__(self) -> None:
        positive(
            M=self.M, eta=self.eta, Gamma=self.Gamma, alpha=self.alpha,
            lanczos_steps=self.lanczos_steps, max_steps=self.max_steps,
        )  # fmt: skip
        if not 0 < self.beta < 1:
            raise ValueError(f"beta = {self.beta}; expected a number between 0 and 1")
        for name, value in (("rho", self.rho), ("energy", self.energy)):
            if not 0 <= value < np.inf:
                raise ValueError(f"{name} = {value}; expected 0, or a positive number")
        if not self.rho_growth >= 1:
            raise ValueError(f"rho_growth = {self.rho_growth}; expected at least 1")
        if not self.alpha <= 2:
            raise ValueError(f"alpha = {self.alpha}; expected at most 2")
        choices = {
            "expansion": EXPANSIONS, "proportioning": PROPORTIONINGS,
            "preconditioner": PRECONDITIONERS, "norm": get_args(Norm),
            "eliminate": get_args(Eliminate),
        }  # fmt: skip
        for name, known in choices.items():
            if (value := getattr(self, name)) not in known:
                raise ValueError(f"{name} = {value!r}; expected {', '.join(known)}")
        model = self.expansion == "model" or self.preconditioner in ("auto", "model")
        if self.norm == "power" and model:
            raise ValueError(
                "norm = 'power' finds no Ritz vectors; expected 'lanczos', or "
                "expansion and preconditioner other than 'model'"
            )
