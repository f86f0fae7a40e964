"""Protocol for user-defined preconditioners and step rules in SMALBE.

A subclass of `solvers.smalbe.solver.SMALBE` overrides `preconditioner_for`,
`step_rule_for`, or both. Each method is called once while a QP is prepared. It returns
a function for this QP, or None to keep the built-in choice. The fields of the subclass
are options, like the fields of SMALBE.

These functions cannot cause SMALBE to claim a wrong solution. A preconditioner changes
only the directions of conjugate gradients. SMALBE projects the trial point of a step
rule onto the bounds and accepts it only if the cost decreases sufficiently
(`StepRule`). In addition, the harness measures the KKT residuals of every claim.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from mortarbench.harness import Vector

#: function v (n,) ↦ Mv (n,) with a symmetric positive definite M ≈ P⁻¹
Operator: TypeAlias = Callable[[Vector], Vector]


class Step(NamedTuple):
    """State of MPRGP when the CG step x − αp would leave the box.

    Costs, gradients and lengths refer to the augmented Lagrangian
    ½xᵀPx + qᵀx + aᵀC(x − x̃) + ρ/2‖C(x − x̃)‖², with orthonormal rows C that span the
    equality rows; without equality rows, they refer to the QP itself.
    """

    x: Vector  #: (n,) iterate, within the bounds
    g: Vector  #: (n,) gradient at x
    p: Vector  #: (n,) direction of conjugate gradients, zero on active bounds; gᵀp > 0
    lb: Vector  #: (n,) lower bounds
    ub: Vector  #: (n,) upper bounds
    alpha_cg: float  #: α that minimises the cost along x − αp; may be inf
    alpha_f: float  #: largest α for which x − αp is within the bounds
    alpha_bar: float  #: length ᾱ of a gradient projection step, 1.9/‖H‖ by default


#: Function of a `Step` that returns a trial point (n,). MPRGP projects the trial point
#: onto the bounds and accepts it if the cost decreases by at least φ̃ᵀφ/(2‖H‖), the
#: decrease from which the convergence rate of MPRGP follows (Dostál and Schöberl 2005).
#: Otherwise MPRGP takes its standard expansion step.
StepRule: TypeAlias = Callable[[Step], Vector]


def checked(M: Operator) -> Operator:
    """Return M with a check of vᵀMv > 0 for each vector v to which M is applied.

    If vᵀMv < 0, conjugate gradients would increase the cost.

    Raises
    ------
    ValueError
        Raised by the returned function if the shapes of Mv and v differ, or if v ≠ 0
        and vᵀMv is not a finite positive number.

    """

    def product(v: Vector) -> Vector:
        Mv = M(v)
        if np.shape(Mv) != np.shape(v):
            raise ValueError(
                f"preconditioner returned shape {np.shape(Mv)}; expected {np.shape(v)}"
            )
        energy = float(v @ Mv)
        if not 0 < energy < np.inf and v.any():
            raise ValueError(
                f"preconditioner has vᵀMv = {energy:.3g}; expected a positive number "
                "(M must be symmetric positive definite)"
            )
        return Mv

    return product
