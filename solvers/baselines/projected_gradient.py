"""Spectral projected gradients on convex sets, by products with P only.

With the projection Π on the product of sets,

    d = Π(x − αg) − x,   x ← x + td

with the step length α = sᵀs/sᵀPs of Barzilai and Borwein (1988), s the last step. The
line search is nonmonotone: the objective may exceed its last value but not the largest
of the last M (Birgin, Martínez and Raydan, Nonmonotone spectral projected gradient
methods on convex sets, SIAM J. Optim. 10, 2000, Algorithm 2.2). The objective is
quadratic along d, so one product Pd per iteration suffices for line search and α.

Alternating with sᵀPs/‖Ps‖² (ABBmin) halves the steps for a string on an obstacle, but
takes five to twenty times as many on the duals of contact problems.

The loop ends by the natural map L(x − Π(x − g/L)), which is zero exactly at solutions;
L is the largest curvature dᵀPd/dᵀd so far. Then x ← Π(v) with v = x − g/L, and
L(v − Π(v)) is normal to the sets at the new x: the multipliers.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np

from mortarbench.harness import (
    QP,
    About,
    Box,
    Cones,
    Discs,
    Solution,
    Status,
    Vector,
    kkt_residuals,
)
from mortarbench.harness.sets.convex import hull
from mortarbench.solvers.baselines.infeasibility_certificate import (
    ROUNDING,
    proves_unbounded,
)
from mortarbench.solvers.common.conversion import check_positive

SUFFICIENT_DECREASE = 1e-4  #: share of the linear decrease that a step must achieve
CLAIM_FACTOR = (
    5.0  #: a point is claimed solved if its KKT residuals are ≤ this times tol
)
MIN_TOL_FACTOR = 1e-4  #: smallest factor of tol before the solve gives up


@dataclass(frozen=True)
class ProjectedGradient:
    """In-house spectral projected gradient method.

    `tol` bounds the natural map, relative to ‖q‖. If the KKT residuals on the QP are
    then not within 5·tol, this bound is lowered; no other point is claimed solved. The
    start is the feasible point nearest to zero, the first α that of the exact line
    search. Iterations are steps; all products with P are counted.
    """

    accepts: ClassVar[tuple[type, ...]] = (Box, Discs, Cones)

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
        return (
            "takes bounds, discs and cones, no rows" if qp.b.size or qp.h.size else None
        )

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        return lambda: _solve(_Task(qp, self, Counter()), tol)


class _State(NamedTuple):
    """Iterate, with its gradient and step length."""

    x: Vector
    g: Vector  #: Px + q
    alpha: float
    costs: tuple[float, ...]  #: objectives of the last M iterates, minus the first one
    most: float  #: largest curvature dᵀPd/dᵀd so far; 1 if all are zero
    direction: Vector | None = None  #: last d if its curvature dᵀPd is zero, else None


@dataclass(frozen=True, eq=False)
class _Task:
    qp: QP
    options: ProjectedGradient
    counts: Counter[str]

    def product(self, v: Vector) -> Vector:
        self.counts["P_products"] += 1
        return np.asarray(self.qp.P @ v)

    def project(self, v: Vector) -> Vector:
        for one in self.qp.sets:
            v = one.project(v)
        return v

    def natural_map(self, s: _State) -> float:
        return s.most * float(np.linalg.norm(s.x - self.project(s.x - s.g / s.most)))


def _start(task: _Task) -> _State:
    qp = task.qp
    lower, upper = hull(qp.sets, qp.q.size)
    x = task.project(np.zeros(qp.q.size))
    g = task.product(x) + qp.q
    # without the components that leave a bound at once
    d = np.where(((x <= lower) & (g > 0)) | ((x >= upper) & (g < 0)), 0.0, -g)
    curvature = float(d @ task.product(d))
    alpha = float(d @ d) / curvature if curvature > 0 else 1.0
    return _State(x, g, alpha, (0.0,), 1 / alpha)


def _step(task: _Task, s: _State) -> _State:
    """Return the next iterate; the objective at x + td is f + t·gᵀd + t²/2·dᵀPd."""
    d = task.project(s.x - s.alpha * s.g) - s.x
    w = task.product(d)
    slope, curvature, square = float(s.g @ d), float(d @ w), float(d @ d)
    rise, t = max(s.costs) - s.costs[-1], 1.0
    if slope + curvature / 2 > rise + SUFFICIENT_DECREASE * slope:
        t = -slope / curvature  # the minimiser along d always decreases enough
    cost = s.costs[-1] + t * slope + t * t / 2 * curvature
    curved = curvature > 1e-15 * np.sqrt(square * float(w @ w))
    alpha = square / curvature if curved else s.alpha
    task.counts["steps"] += 1
    task.counts["shortened"] += t < 1
    return _State(
        task.project(s.x + t * d), s.g + t * w, alpha,
        (*s.costs, cost)[-task.options.memory :], max(s.most, 1 / alpha),
        None if curved else d,
    )  # fmt: skip


def _solve(task: _Task, tol: float) -> Solution:
    """Lower the bound of the natural map until the KKT residuals are within 5·tol."""
    qp, s, tighter = task.qp, _start(task), 1.0
    size = float(np.linalg.norm(qp.q)) or float(np.linalg.norm(s.g))
    while True:
        while task.natural_map(s) > tighter * tol * size:
            if task.counts["steps"] >= task.options.max_iter:
                point = _point(task, s, s.x - s.g / s.most)
                return _unsolved(point, "step limit")
            s = _step(task, s)
            if s.direction is not None and _proves_unbounded(qp, s.direction):
                message = "the objective is unbounded below"
                return Solution.without_point(qp, Status.INFEASIBLE, message)
        v = s.x - s.g / s.most
        x = task.project(v)
        # the steps only update g
        s = s._replace(x=x, g=task.product(x) + qp.q)
        point = _point(task, s, v)
        worst = kkt_residuals(qp, point).worst
        if worst <= CLAIM_FACTOR * tol:
            return point
        tighter *= min(0.5, CLAIM_FACTOR * tol / worst)
        if tighter < MIN_TOL_FACTOR:
            return _unsolved(point, "no further progress in rounding")


def _proves_unbounded(qp: QP, d: Vector) -> bool:
    """Return True if the objective falls along d for ever, which stays in all sets."""
    size = float(np.abs(d).max(initial=0.0))
    return all(
        np.abs(one.project(d) - d).max() <= ROUNDING * size for one in qp.sets[1:]
    ) and proves_unbounded(qp, d)


def _unsolved(point: Solution, message: str) -> Solution:
    return replace(point, status=Status.ITERATION_LIMIT, message=message)


def _point(task: _Task, s: _State, v: Vector) -> Solution:
    """Return the iterate; L(v − Π(v)) with v = x − g/L is normal to the sets."""
    task.counts["P_products"] += 1  # of the residuals that follow
    return Solution(
        status=Status.SOLVED, x=s.x, y=np.zeros(0), z=np.zeros(0),
        z_box=s.most * (v - task.project(v)), iterations=task.counts["steps"],
        counts={k: task.counts[k] for k in ("P_products", "shortened")},
        message="converged",
    )  # fmt: skip
