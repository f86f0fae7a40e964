"""Spectral projected gradient method on convex sets, which needs only products with P.

With the projection Π on the product of sets,

    d = Π(x − αg) − x,   x ← x + td

where g = Px + q is the gradient, and α = sᵀs/sᵀPs is the step length of Barzilai and
Borwein (1988) for the previous step s. The line search for t is nonmonotone: the
objective may exceed its last value, but not the largest of its last M values (Birgin,
Martínez and Raydan, Nonmonotone spectral projected gradient methods on convex sets,
SIAM J. Optim. 10, 2000, Algorithm 2.2). The objective is quadratic along d, so one
product Pd per iteration suffices for both the line search and the next α.

Alternating α with the step length sᵀPs/‖Ps‖² (ABBmin) halves the number of steps for a
string on an obstacle. On the duals of contact problems, however, this alternation
multiplies the number of steps by five to twenty.

The stopping test uses the natural map (`solvers.baselines.natural_map`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
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
)
from mortarbench.harness.sets.convex import hull
from mortarbench.solvers.baselines.natural_map import Problem
from mortarbench.solvers.common.conversion import check_positive
from mortarbench.solvers.common.infeasibility_certificate import (
    ROUNDING,
    proves_unbounded,
)

SUFFICIENT_DECREASE = 1e-4  #: fraction of the linear decrease that a step must achieve


@dataclass(frozen=True)
class ProjectedGradient:
    """In-house spectral projected gradient method.

    The iteration stops when the norm of the natural map is at most tol·‖q‖ and the
    relative KKT residual is at most tol. It starts from the feasible point nearest to
    zero, and the first α is the length of an exact line search. The solver reports the
    number of steps as iterations, and counts all products with P.
    """

    accepts: ClassVar[tuple[type, ...]] = (Box, Discs, Cones)

    memory: int = 10  #: M of the line search; 1 for a monotone decrease
    max_iter: int = 50_000

    about: ClassVar[About] = About(
        title="Spectral projected gradient (ours)",
        licence="BSD-3-Clause",
        method="projected gradient with Barzilai-Borwein steps",
        linear_solver="none (products with P)",
        phases="all work is timed as solving",
        limits=(
            "The number of products varies strongly between the load steps of the "
            "benchmark, from 45 to 546.",
        ),
    )

    def __post_init__(self) -> None:
        check_positive(memory=self.memory, max_iter=self.max_iter)

    def declines(self, qp: QP) -> str | None:
        return (
            "accepts bounds, discs and cones, but no rows"
            if qp.b.size or qp.h.size
            else None
        )

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        return lambda: _solve(Problem(qp), tol, self)


class _State(NamedTuple):
    """Iterate, with its gradient and step length."""

    x: Vector
    g: Vector  #: Px + q
    alpha: float
    #: objectives of the last M iterates, relative to the objective of the first iterate
    costs: tuple[float, ...]
    #: largest curvature dᵀPd/dᵀd so far; at least 1 if the first curvature was ≤ 0
    most: float


def _start(problem: Problem) -> _State:
    qp = problem.qp
    lower, upper = hull(qp.sets, qp.q.size)
    x = problem.project(np.zeros(qp.q.size))
    g = problem.product(x) + qp.q
    # omit the components whose descent direction points out of the box
    d = np.where(((x <= lower) & (g > 0)) | ((x >= upper) & (g < 0)), 0.0, -g)
    curvature = float(d @ problem.product(d))
    alpha = float(d @ d) / curvature if curvature > 0 else 1.0
    return _State(x, g, alpha, (0.0,), 1 / alpha)


def _step(problem: Problem, memory: int, s: _State) -> _State | Solution:
    """Return the next iterate, or a `Solution` if the objective is unbounded below."""
    d = problem.project(s.x - s.alpha * s.g) - s.x
    w = problem.product(d)
    slope, curvature, square = float(s.g @ d), float(d @ w), float(d @ d)
    rise, t = max(s.costs) - s.costs[-1], 1.0
    if slope + curvature / 2 > rise + SUFFICIENT_DECREASE * slope:
        # the minimiser along d always satisfies the condition of sufficient decrease
        t = -slope / curvature
    cost = s.costs[-1] + t * slope + t * t / 2 * curvature
    curved = curvature > 1e-15 * np.sqrt(square * float(w @ w))
    alpha = square / curvature if curved else s.alpha
    if not curved and _proves_unbounded(problem.qp, d):
        message = "the objective is unbounded below"
        return Solution.without_point(problem.qp, Status.UNBOUNDED, message)
    problem.counts["shortened"] += t < 1
    return _State(
        problem.project(s.x + t * d),
        s.g + t * w,
        alpha,
        (*s.costs, cost)[-memory:],
        max(s.most, 1 / alpha),
    )


def _solve(problem: Problem, tol: float, options: ProjectedGradient) -> Solution:
    problem.counts["shortened"] = 0
    return problem.solved(
        _start(problem),
        partial(_step, problem, options.memory),
        lambda s, x, g: s._replace(x=x, g=g),
        tol,
        options.max_iter,
    )


def _proves_unbounded(qp: QP, d: Vector) -> bool:
    """Return True if d is a feasible direction of unbounded decrease."""
    size = float(np.abs(d).max(initial=0.0))
    return all(
        np.abs(one.project(d) - d).max() <= ROUNDING * size for one in qp.sets[1:]
    ) and proves_unbounded(qp, d)
