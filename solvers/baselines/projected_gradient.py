"""Spectral projected gradients for bounds, by products with P only.

    d = clip(x − αg, lb, ub) − x,   x ← x + td

with the step length α = sᵀs/sᵀPs of Barzilai and Borwein (1988), s the last step. The
line search is nonmonotone: the objective may exceed its last value but not the largest
of the last M (Birgin, Martínez and Raydan, Nonmonotone spectral projected gradient
methods on convex sets, SIAM J. Optim. 10, 2000, Algorithm 2.2). The objective is
quadratic along d, so one product Pd per iteration suffices for line search and α.

Alternating with sᵀPs/‖Ps‖² (ABBmin) halves the steps for a string on an obstacle, but
takes five to twenty times as many on the duals of contact problems.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np

from mortarbench.harness import QP, About, Solution, Status, Vector, kkt_residuals
from mortarbench.solvers.baselines.infeasibility_certificate import proves_unbounded
from mortarbench.solvers.common.conversion import check_positive

SUFFICIENT_DECREASE = 1e-4  #: share of the linear decrease that a step must achieve
CLAIM_FACTOR = (
    5.0  #: a point is claimed solved if its KKT residuals are ≤ this times tol
)
MIN_TOL_FACTOR = 1e-4  #: smallest factor of tol before the solve gives up


@dataclass(frozen=True)
class ProjectedGradient:
    """In-house spectral projected gradient method.

    `tol` bounds ‖g^P‖/‖q‖ with the projected gradient g^P. If the KKT residuals on the
    QP are then not within 5·tol, this bound is lowered; no other point is claimed
    solved. The start is the point of the box nearest to zero, the first α that of the
    exact line search. Iterations are steps; all products with P are counted.
    """

    memory: int = 10  #: M of the line search; 1 is monotone
    max_iter: int = 50_000

    about: ClassVar[About] = About(
        title="Spectral projected gradient (ours)", licence="BSD-3-Clause",
        method="projected gradient with Barzilai-Borwein steps",
        linear_solver="none (products with P)",
        phases="everything happens in solving",
        limits=("irregular: 45 to 546 products over the load steps of the benchmark",),
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_positive(memory=self.memory, max_iter=self.max_iter)

    def declines(self, qp: QP) -> str | None:
        return "takes bounds only" if qp.b.size or qp.h.size else None

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        return lambda: _solve(_Task(qp, self, Counter()), tol)


class _State(NamedTuple):
    """Iterate, with its gradient and step length."""

    x: Vector
    g: Vector  #: Px + q
    alpha: float
    costs: tuple[float, ...]  #: objectives of the last M iterates, minus the first one
    direction: Vector | None = None  #: last d if its curvature dᵀPd is zero, else None


@dataclass(frozen=True, eq=False)
class _Task:
    qp: QP
    options: ProjectedGradient
    counts: Counter[str]

    def product(self, v: Vector) -> Vector:
        self.counts["P_products"] += 1
        return np.asarray(self.qp.P @ v)

    def downhill(self, s: _State) -> Vector:
        """Return −g^P: −g without the components that point out of the box."""
        out = ((s.x <= self.qp.lb) & (s.g > 0)) | ((s.x >= self.qp.ub) & (s.g < 0))
        return np.where(out, 0.0, -s.g)


def _start(task: _Task) -> _State:
    qp = task.qp
    x = np.clip(np.zeros(qp.q.size), qp.lb, qp.ub)
    s = _State(x, task.product(x) + qp.q, 1.0, (0.0,))
    d = task.downhill(s)
    curvature = float(d @ task.product(d))
    return s._replace(alpha=float(d @ d) / curvature if curvature > 0 else 1.0)


def _step(task: _Task, s: _State) -> _State:
    """Return the next iterate; the objective at x + td is f + t·gᵀd + t²/2·dᵀPd."""
    lb, ub = task.qp.lb, task.qp.ub
    d = np.clip(s.x - s.alpha * s.g, lb, ub) - s.x
    w = task.product(d)
    slope, curvature, square = float(s.g @ d), float(d @ w), float(d @ d)
    rise, t = max(s.costs) - s.costs[-1], 1.0
    if slope + curvature / 2 > rise + SUFFICIENT_DECREASE * slope:
        t = -slope / curvature  # the minimiser along d always decreases enough
    cost = s.costs[-1] + t * slope + t * t / 2 * curvature
    curved = curvature > 1e-15 * np.sqrt(square * float(w @ w))
    task.counts["steps"] += 1
    task.counts["shortened"] += t < 1
    return _State(
        np.clip(s.x + t * d, lb, ub), s.g + t * w,
        square / curvature if curved else s.alpha,
        (*s.costs, cost)[-task.options.memory :], None if curved else d,
    )  # fmt: skip


def _solve(task: _Task, tol: float) -> Solution:
    """Lower the bound of ‖g^P‖ until the KKT residuals are within 5·tol."""
    qp, s, tighter = task.qp, _start(task), 1.0
    size = float(np.linalg.norm(qp.q)) or float(np.linalg.norm(s.g))
    while True:
        while float(np.linalg.norm(task.downhill(s))) > tighter * tol * size:
            if task.counts["steps"] >= task.options.max_iter:
                return _unsolved(_point(task, s), "step limit")
            s = _step(task, s)
            if s.direction is not None and proves_unbounded(qp, s.direction):
                message = "the objective is unbounded below"
                return Solution.without_point(qp, Status.INFEASIBLE, message)
        # g was updated by g + tPd; recompute it before it becomes the multipliers
        s = s._replace(g=task.product(s.x) + qp.q)
        point = _point(task, s)
        worst = kkt_residuals(qp, point).worst
        if worst <= CLAIM_FACTOR * tol:
            return point
        tighter *= min(0.5, CLAIM_FACTOR * tol / worst)
        if tighter < MIN_TOL_FACTOR:
            return _unsolved(point, "no further progress in rounding")


def _unsolved(point: Solution, message: str) -> Solution:
    return replace(point, status=Status.ITERATION_LIMIT, message=message)


def _point(task: _Task, s: _State) -> Solution:
    """Return the point; the multipliers of active bounds are components of −g."""
    lb, ub = task.qp.lb, task.qp.ub
    z_box = np.where(s.x <= lb, -np.maximum(s.g, 0), 0.0)
    z_box += np.where(s.x >= ub, -np.minimum(s.g, 0), 0.0)
    task.counts["P_products"] += 1  # of the residuals that follow
    return Solution(
        status=Status.SOLVED, x=s.x, y=np.zeros(0), z=np.zeros(0), z_box=z_box,
        iterations=task.counts["steps"], message="converged",
        counts={k: task.counts[k] for k in ("P_products", "shortened")},
    )  # fmt: skip
