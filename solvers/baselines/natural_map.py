"""Natural map of a QP on convex sets, and an iteration loop that uses this map.

Let Π be the projection onto the product of the sets, L a curvature, and g = Px + q. The
natural map L(x − Π(x − g/L)) is zero if and only if x is a solution. With v = x − g/L,
the vector L(v − Π(v)) is normal to the sets at Π(v), so it is used as the vector of
multipliers at Π(v).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar

import numpy as np

from mortarbench.harness import QP, Solution, Status, Vector
from mortarbench.solvers.common.stopping import relative_residual

#: the solve fails if its reduced tolerance falls below this factor times tol
MIN_TOL_FACTOR = 1e-4


class Iterate(Protocol):
    """A point with its gradient and the curvature L of the natural map."""

    @property
    def x(self) -> Vector:
        """The point x (n,), which is in all sets."""

    @property
    def g(self) -> Vector:
        """Gradient Px + q."""

    @property
    def most(self) -> float:
        """Largest curvature dᵀPd/dᵀd so far, or an initial estimate; used as L."""


I = TypeVar("I", bound=Iterate)


@dataclass(frozen=True, eq=False)
class Problem:
    """A QP without rows, with counts of products and steps."""

    qp: QP
    counts: Counter[str] = field(default_factory=Counter)

    def product(self, v: Vector) -> Vector:
        """Return Pv."""
        self.counts["P_products"] += 1
        return np.asarray(self.qp.P @ v)

    def project(self, v: Vector) -> Vector:
        """Return Π(v), the point of the product of sets that is nearest to v."""
        for one in self.qp.sets:
            v = one.project(v)
        return v

    def natural_map(self, at: Iterate) -> float:
        """Return the 2-norm of the natural map."""
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
        """Take steps until the relative KKT residual is at most tol.

        The residual is evaluated when the norm of the natural map is at most tol·‖q‖;
        if q = 0, ‖q‖ is replaced by the initial ‖g‖. If the residual is too large, the
        loop continues with a smaller bound. The status is SOLVED only if the residual
        is at most tol.

        step : iterate ↦ the next iterate, or a solution that ends the loop
        restarted : iterate, x and the gradient at x ↦ an iterate at x
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
            # recompute g to remove the rounding errors of its updates
            at = restarted(at, x, self.product(x) + qp.q)
            point = self._point(x, v, at.most)
            worst = relative_residual(qp, point, tol)
            if worst <= tol:
                return point
            tighter *= min(0.5, tol / worst)
            if tighter < MIN_TOL_FACTOR:
                return _unsolved(point, "no further progress because of rounding")

    def _point(self, x: Vector, v: Vector, most: float) -> Solution:
        """Return x with the multipliers L(v − Π(v)), where L = `most`."""
        # the evaluation of the KKT residual by the caller takes one product
        self.counts["P_products"] += 1
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
