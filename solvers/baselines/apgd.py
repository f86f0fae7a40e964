"""Accelerated projected gradients on convex sets, as used in granular dynamics.

With the projection Π on the product of sets and a curvature L,

    x⁺ = Π(y − (Py + q)/L),   y⁺ = x⁺ + β(x⁺ − x).

Nesterov's weights β restart from 0 if x⁺ − x is an ascent direction at y. In each step,
L increases until it bounds the curvature along the step; after the step, L is reduced
(Mazhar, Heyn, Negrut and Tasora, Using Nesterov's method to accelerate multibody
dynamics with friction and contact, ACM Trans. Graph. 34, 2015, Algorithm 1). Py is a
linear combination of the last two products Px. A step therefore takes one product with
P and one additional product for each increase of L.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np

from mortarbench.harness import QP, About, Box, Cones, Discs, Solution, Vector
from mortarbench.solvers.baselines.natural_map import Problem
from mortarbench.solvers.common.conversion import check_positive

ROUNDING = 1e-12  #: relative rounding error of a curvature


@dataclass(frozen=True)
class AcceleratedGradient:
    """In-house accelerated projected gradient method (APGD).

    The iteration stops when the norm of the natural map is at most tol·‖q‖ and the
    relative KKT residual is at most tol. It starts from the feasible point nearest to
    zero. It reports the number of steps as iterations, and counts all products with P.
    """

    accepts: ClassVar[tuple[type, ...]] = (Box, Discs, Cones)

    shrink: float = 0.9  #: multiplies L after each step; with 1, L never decreases
    #: each increase raises L to growth·L, or to the curvature along the step if the
    #: curvature is larger
    growth: float = 2.0
    max_iter: int = 50_000

    about: ClassVar[About] = About(
        title="Accelerated projected gradient (ours)",
        licence="BSD-3-Clause",
        method="Nesterov's method with restarts and an adaptive step",
        linear_solver="none (products with P)",
        phases="all work is timed as solving",
    )

    def __post_init__(self) -> None:
        check_positive(shrink=self.shrink, max_iter=self.max_iter)
        if not self.shrink <= 1:
            raise ValueError(f"shrink = {self.shrink}; expected at most 1")
        if not 1 < self.growth < np.inf:
            raise ValueError(f"growth = {self.growth}; expected a number above 1")

    def declines(self, qp: QP) -> str | None:
        return (
            "accepts bounds, discs and cones, but no rows"
            if qp.b.size or qp.h.size
            else None
        )

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        def solve() -> Solution:
            problem = Problem(qp)
            step = partial(_step, problem, self)
            return problem.solved(_start(problem), step, _at, tol, self.max_iter)

        return solve


class _State(NamedTuple):
    x: Vector
    g: Vector  #: Px + q
    y: Vector  #: extrapolated point
    g_y: Vector  #: Py + q
    weight: float  #: θ, which determines β; 1 at the start and after a restart
    L: float
    most: float  #: initial L, or a larger curvature dᵀPd/dᵀd found so far


def _start(problem: Problem) -> _State:
    """Return the initial state; L = ‖Pd‖/‖d‖ for d = q, or for all ones if q = 0."""
    q = problem.qp.q
    x = problem.project(np.zeros(q.size))
    d = q if q.any() else np.ones(q.size)
    L = float(np.linalg.norm(problem.product(d)) / np.linalg.norm(d)) or 1.0
    g = problem.product(x) + q
    return _State(x, g, x, g, 1.0, L, L)


def _at(s: _State, x: Vector, g: Vector) -> _State:
    return s._replace(x=x, g=g, y=x, g_y=g, weight=1.0)


def _step(problem: Problem, options: AcceleratedGradient, s: _State) -> _State:
    L, most = s.L, s.most
    while True:
        x = problem.project(s.y - s.g_y / L)
        d = x - s.y
        g = problem.product(x) + problem.qp.q
        square, work = float(d @ d), float(d @ (g - s.g_y))
        curvature = work / square if square else 0.0
        most = max(most, curvature)
        # along tiny steps, rounding errors of g dominate the computed curvature
        rounding = ROUNDING * float(np.linalg.norm(g)) * np.sqrt(square)
        if work <= L * square + rounding:
            break
        L = max(curvature, options.growth * L)
    t = s.weight
    after = (t * np.sqrt(t * t + 4) - t * t) / 2
    share = t * (1 - t) / (t * t + after)
    if s.g_y @ (x - s.x) > 0:
        after, share = 1.0, 0.0
    return _State(
        x,
        g,
        x + share * (x - s.x),
        g + share * (g - s.g),
        after,
        options.shrink * L,
        most,
    )
