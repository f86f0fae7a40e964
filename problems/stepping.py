"""Load steps with re-linearised contact (the paper's pseudo-time steps, Section 2).

Step k carries the load (k/steps)·f. Its contact rows are linearised at the solution of
step k − 1, and `relin` − 1 more times at its own solution; the emitted QP is the last.
With relin = 1 this is the paper's scheme, of first order in 1/steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from harness import QP, Reference, Vector
from problems.bodies import Bodies
from problems.contact import ContactRows
from problems.dual import Transformed, dualise, eliminate
from problems.inverse import GeneralisedInverse

Linearise = Callable[[Vector], ContactRows]  #: displacement (n,) in m → rows


@dataclass(frozen=True, eq=False)
class LoadPath:
    """The load steps of one analysis; what was solved once is remembered."""

    bodies: Bodies
    linearise: Linearise
    clamped: GeneralisedInverse  #: of K without the prescribed components
    reference: Reference
    steps: int
    relin: int
    _solutions: list[Vector] = field(default_factory=list)  #: of steps 1, 2, …

    def primal(self, k: int) -> QP:
        """Emit the QP of step k (1 … steps), as last linearised."""
        u = self.solution(k - 1)
        for _ in range(self.relin - 1):
            u = self._solve(self._linearised(u, k))
        return self._linearised(u, k)

    def solution(self, k: int) -> Vector:
        """Return the non-dimensional displacement (n,) after step k; zero for k = 0."""
        while len(self._solutions) < k:
            following = self.primal(len(self._solutions) + 1)
            self._solutions.append(self._solve(following))
        return self._solutions[k - 1] if k else np.zeros(self.bodies.mesh.dofs)

    def _linearised(self, u: Vector, k: int) -> QP:
        rows = self.linearise(u * self.bodies.length)
        return primal_qp(self.bodies, rows, k / self.steps)

    def _solve(self, primal: QP) -> Vector:
        dual = dual_bounds(primal, self.clamped)
        return dual.recover(self.reference(dual.qp)).x


def primal_qp(bodies: Bodies, rows: ContactRows, load_factor: float = 1.0) -> QP:
    """Emit  min ½uᵀKu − fᵀu,  B_D u = 0,  B_M u ≤ c_M  without dimensions; (1)."""
    n = bodies.mesh.dofs
    return QP(
        P=bodies.K, q=-load_factor * bodies.f,
        A=bodies.B_D, b=np.zeros(bodies.B_D.shape[0]),
        G=rows.B, h=rows.c / bodies.length,
        lb=np.full(n, -np.inf), ub=np.full(n, np.inf),
    )  # fmt: skip


def dual_bounds(primal: QP, clamped: GeneralisedInverse) -> Transformed:
    """Eliminate the Dirichlet rows, then dualise: λ_I ≥ 0 is the only constraint."""
    first = eliminate(primal)
    second = dualise(first.qp, clamped)
    return Transformed(
        second.qp,
        lambda s: first.recover(second.recover(s)),
        first.sign * second.sign,
        first.sign * second.constant + first.constant,
    )
