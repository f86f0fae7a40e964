"""Load steps with re-linearised contact (the paper's pseudo-time steps, Section 2).

Step k carries the load (k/steps)·f. Its contact rows are linearised at the solution of
step k − 1, and `relin` − 1 more times at its own solution; the emitted QP is the last.
With relin = 1 this is the paper's scheme, of first order in 1/steps.

Contact rows are linearised at displacements of the contact sides: those of a step are
had from its dual solution by one small product, and only displacements that are asked
for are recovered everywhere, by one solve with the factor of K each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from harness import QP, Reference, Solution, Vector, kkt_residuals
from problems.contact.bodies import Bodies
from problems.contact.node_to_segment import ContactRows
from problems.duality.dualisation import Transformed, dual_bounds
from problems.fem.inverse import GeneralisedInverse

Linearise = Callable[[Vector], ContactRows]  #: displacement (n,) in m → rows
Transform = Callable[[QP, GeneralisedInverse, Vector], Transformed]


#: residual that a reference solve may leave: the next step is linearised there
REFERENCE = 1e-6


@dataclass(frozen=True, eq=False)
class _Solved:
    """A transformed QP and its solution."""

    transformed: Transformed
    solution: Solution

    @cached_property
    def on_sides(self) -> Vector:
        """Displacement u (n,), right on the contact sides."""
        return self.transformed.touched(self.solution)

    @cached_property
    def answer(self) -> Solution:
        """Solution of the primal QP."""
        return self.transformed.recover(self.solution)


@dataclass(frozen=True, eq=False)
class LoadPath:
    """The load steps of one analysis; what was solved once is remembered.

    Raises
    ------
    ArithmeticError
        When a reference solve is not accurate.

    """

    bodies: Bodies
    linearise: Linearise
    inverse: GeneralisedInverse  #: K⁺ that `transform` needs
    reference: Reference
    steps: int
    relin: int = 1
    transform: Transform = dual_bounds
    _solved: list[_Solved] = field(default_factory=list)  #: steps 1, 2, …

    def primal(self, k: int) -> QP:
        """Emit the QP of step k (1 … steps), as last linearised."""
        u = self._step(k - 1).on_sides if k > 1 else np.zeros(self.bodies.mesh.dofs)
        for _ in range(self.relin - 1):
            u = self._solve(self._linearised(u, k), k / self.steps).on_sides
        return self._linearised(u, k)

    def answer(self, k: int) -> Solution:
        """Return the solution of the primal QP of step k (1 … steps)."""
        return self._step(k).answer

    def solution(self, k: int) -> Vector:
        """Return the non-dimensional displacement (n,) after step k; zero for k = 0."""
        return self.answer(k).x if k else np.zeros(self.bodies.mesh.dofs)

    def _step(self, k: int) -> _Solved:
        while len(self._solved) < k:
            j = len(self._solved) + 1
            self._solved.append(self._solve(self.primal(j), j / self.steps))
        return self._solved[k - 1]

    def _linearised(self, u: Vector, k: int) -> QP:
        rows = self.linearise(u * self.bodies.length)
        return primal_qp(self.bodies, rows, k / self.steps)

    def _solve(self, primal: QP, load_factor: float) -> _Solved:
        dual = self.transform(primal, self.inverse, self._free * load_factor)
        s = self.reference(dual.qp)
        if not (worst := kkt_residuals(dual.qp, s).worst) <= REFERENCE:
            raise ArithmeticError(
                f"the reference solve at load factor {load_factor:g} left a residual "
                f"of {worst:.1e}, more than {REFERENCE:g}"
            )
        return _Solved(dual, s)

    @cached_property
    def _free(self) -> Vector:
        """K⁺f: the full load without contact."""
        return self.inverse(self.bodies.f)


def primal_qp(bodies: Bodies, rows: ContactRows, load_factor: float = 1.0) -> QP:
    """Emit  min ½uᵀKu − fᵀu,  B_D u = 0,  B_M u ≤ c_M  without dimensions; (1)."""
    n = bodies.mesh.dofs
    return QP(
        P=bodies.K, q=-load_factor * bodies.f,
        A=bodies.B_D, b=np.zeros(bodies.B_D.shape[0]),
        G=rows.B, h=rows.c / bodies.length,
        lb=np.full(n, -np.inf), ub=np.full(n, np.inf),
    )  # fmt: skip
