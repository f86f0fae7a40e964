"""The natural map of a QP on convex sets, and a loop until it meets a tolerance.

With the projection Π on the product of sets and a curvature L, the natural map
L(x − Π(x − g/L)) is zero exactly at solutions. With v = x − g/L, the vector L(v − Π(v))
is normal to the sets at Π(v): the multipliers there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar

import numpy as np

from mortarbench.harness import QP, Solution, Status, Vector, kkt_residuals

#: a point is claimed solved if its KKT residuals are ≤ this times tol
CLAIM_FACTOR = 5.0
MIN_TOL_FACTOR = 1e-4  #: smallest factor of tol before the solve gives up


class Iterate(Protocol):
    """A point, its gradient, and the curvature of its natural map."""

    @property
    def x(self) -> Vector:
        """The point (n,), in the sets."""

    @property
    def g(self) -> Vector:
        """Px + q."""

    @property
    def most(self) -> float:
        """L, the largest curvature dᵀPd/dᵀd so far."""


I = TypeVar("I", bound=Iterate)


@dataclass(frozen=True, eq=False)
class Problem:
    """A QP without rows, whose products and steps are counted."""

    qp: QP
    counts: Counter[str] = field(default_factory=Counter)

    def product(self, v: Vector) -> Vector:
        """Return Pv."""
        self.counts["P_products"] += 1
        return np.asarray(self.qp.P @ v)

    def project(self, v: Vector) -> Vector:
        """Return the point of the sets that is nearest to v."""
        for one in self.qp.sets:
            v = one.project(v)
        return v

    def natural_map(self, at: Iterate) -> float:
        """Return the norm of the natural map."""
        v = at.x - at.g / at.most
        return at.most * float(np.linalg.norm(at.x - self.project(v)))

    def solved(
        self,
        at: I,
        step: Callable[[I], I | Solution],
        restarted: Callable[[I, Vector, Vector], I],
        tol: float,
        max_iter: int,
    ) -> Solution:
        """Take steps until the KKT residuals are within 5·tol.

        The residuals are evaluated when the natural map falls below tol‖q‖; if they
        are too large, this bound is lowered. No other point is claimed solved.

        step : iterate ↦ the next one, or a solution that ends the solve
        restarted : iterate, x and its gradient ↦ an iterate at x
        """
        qp, tighter = self.qp, 1.0
        size = float(np.linalg.norm(qp.q)) or float(np.linalg.norm(at.g))
        while True:
            while self.natural_map(at) > tighter * tol * size:
                if self.counts["steps"] >= max_iter:
                    point = self._point(at.x, at.x - at.g / at.most, at.most)
                    return _unsolved(point, "step limit")
                after = step(at)
                if isinstance(after, Solution):
                    return after
                at = after
                self.counts["steps"] += 1
            v = at.x - at.g / at.most
            x = self.project(v)
            at = restarted(at, x, self.product(x) + qp.q)  # steps only update g
            point = self._point(x, v, at.most)
            worst = kkt_residuals(qp, point).worst
            if worst <= CLAIM_FACTOR * tol:
                return point
            tighter *= min(0.5, CLAIM_FACTOR * tol / worst)
            if tighter < MIN_TOL_FACTOR:
                return _unsolved(point, "no further progress in rounding")

    def _point(self, x: Vector, v: Vector, most: float) -> Solution:
        """Return x with the multipliers L(v − Π(v))."""
        self.counts["P_products"] += 1  # for the residuals that follow
        return Solution(
            status=Status.SOLVED,
            x=x,
            y=np.zeros(0),
            z=np.zeros(0),
            z_box=most * (v - self.project(v)),
            iterations=self.counts["steps"],
            counts={k: count for k, count in self.counts.items() if k != "steps"},
            message="converged",
        )


def _unsolved(point: Solution, message: str) -> Solution:
    return replace(point, status=Status.ITERATION_LIMIT, message=message)
