"""Projected Gauss–Seidel over discs and cones, as used in granular dynamics.

A sweep minimises the objective over one block of variables at a time, with all other
variables fixed. A block consists of the variables of one disc or cone, or of a single
other variable. The method is known as NSGS (nonsmooth Gauss–Seidel: Jourdan, Alart and
Jean, Comput. Methods Appl. Mech. Engrg. 155, 1998, 31–47; Acary and Brogliato 2008,
Chapter 13). The problem on a block is solved by projected gradient steps of length 1/λ,
where λ is the largest eigenvalue of the diagonal block of P. The steps end when they
become short.

After each change of a block, the gradient is updated with the columns of P of this
block. A sweep over all blocks therefore costs about as much as a product with P.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from math import hypot, sqrt
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mortarbench.harness import QP, About, Box, Cones, Discs, Solution, Vector
from mortarbench.harness.qp import NEEDS_MATRICES
from mortarbench.solvers.baselines.natural_map import Problem
from mortarbench.solvers.common.conversion import check_positive

#: The steps on a block end when the ratio of the last to the first step length is at
#: most this value. With the value 1, which permits a single step, 30 QPs with cones
#: take 70 sweeps on average. With 1e-3 or 1e-6, they take 34 sweeps.
SETTLED = 1e-3
MAX_LOCAL = 100  #: largest number of steps on a block in one sweep

Point = list[float]


@dataclass(frozen=True)
class GaussSeidel:
    """In-house projected Gauss–Seidel method (NSGS).

    The iteration stops when the norm of the natural map after a sweep is at most
    tol·‖q‖ and the relative KKT residual is at most tol. It starts from the feasible
    point nearest to zero. It reports the number of sweeps as iterations; a sweep costs
    about as much as one product with P.
    """

    accepts: ClassVar[tuple[type, ...]] = (Box, Discs, Cones)

    max_iter: int = 10_000  #: largest number of sweeps

    about: ClassVar[About] = About(
        title="Projected Gauss–Seidel (ours)",
        licence="BSD-3-Clause",
        method="block Gauss–Seidel over discs, cones and single variables (NSGS)",
        linear_solver="none (columns of P)",
        phases="all work is timed as solving",
        limits=(
            "The loop over blocks is written in Python, so compare numbers of sweeps "
            "rather than times.",
        ),
    )

    def __post_init__(self) -> None:
        check_positive(max_iter=self.max_iter)

    def declines(self, qp: QP) -> str | None:
        if qp.b.size or qp.h.size:
            return "accepts bounds, discs and cones, but no rows"
        if not qp.is_explicit:
            return NEEDS_MATRICES
        diagonal = qp.diagonal()
        if diagonal is None or not (diagonal > 0).all():
            return "needs a P with a positive diagonal"
        return None

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        def solve() -> Solution:
            problem = Problem(qp)
            x = problem.project(np.zeros(qp.q.size))
            g = problem.product(x) + qp.q
            diagonal = np.asarray(qp.diagonal())
            start = _State(x, g, float(diagonal.max()))
            step = partial(_sweep, problem, list(_blocks(qp)), _columns(qp))
            return problem.solved(start, step, _at, tol, self.max_iter)

        return solve


class _State(NamedTuple):
    x: Vector
    g: Vector  #: Px + q
    #: largest curvature dᵀPd/dᵀd so far, where d is the change of x in a sweep
    most: float


class _Block(NamedTuple):
    """Block of variables, with the diagonal block A of P."""

    variables: NDArray[np.int64]  #: (d,)
    A: list[Point]  #: (d, d)
    length: float  #: step length 1/‖A‖
    project: Callable[[Point], Point]  #: projection onto the set of the block


def _blocks(qp: QP) -> Iterator[_Block]:
    """Yield a block for each disc and cone, then one for each remaining variable."""
    alone = np.ones(qp.q.size, dtype=bool)
    for one in qp.sets[1:]:
        alone[one.block] = False
        if isinstance(one, Discs):
            for index, radius in zip(one.index, one.radius, strict=True):
                yield _block(qp, index, partial(_on_disc, float(radius)))
        elif isinstance(one, Cones):
            for index, slope in zip(one.index, one.slope, strict=True):
                yield _block(qp, index, partial(_on_cone, float(slope)))
    for i in np.flatnonzero(alone):
        bounds = float(qp.lb[i]), float(qp.ub[i])
        yield _block(qp, np.array([i]), partial(_on_interval, *bounds))


def _block(
    qp: QP, index: NDArray[np.int64], project: Callable[[Point], Point]
) -> _Block:
    A = qp.P[np.ix_(index, index)] if isinstance(qp.P, np.ndarray) else _part(qp, index)
    largest = float(np.linalg.eigvalsh(A)[-1])
    return _Block(index, A.tolist(), 1 / largest, project)


def _part(qp: QP, index: NDArray[np.int64]) -> NDArray[np.float64]:
    part: NDArray[np.float64] = qp.P[index][:, index].toarray()
    return part


def _columns(qp: QP) -> Callable[[NDArray[np.int64], Vector, Vector], None]:
    """Return a function that adds P[:, index] d to a vector g (n,)."""
    if isinstance(qp.P, np.ndarray):
        P = qp.P if qp.P.flags.c_contiguous else qp.P.T  # P is symmetric

        def add(index: NDArray[np.int64], d: Vector, g: Vector) -> None:
            for i, change in zip(index, d, strict=True):
                g += change * P[i]

        return add
    rows = csr_array(qp.P)

    def add_sparse(index: NDArray[np.int64], d: Vector, g: Vector) -> None:
        for i, change in zip(index, d, strict=True):
            at = slice(rows.indptr[i], rows.indptr[i + 1])
            g[rows.indices[at]] += change * rows.data[at]

    return add_sparse


def _at(s: _State, x: Vector, g: Vector) -> _State:
    return s._replace(x=x, g=g)


def _sweep(
    problem: Problem,
    blocks: list[_Block],
    add_columns: Callable[[NDArray[np.int64], Vector, Vector], None],
    s: _State,
) -> _State:
    x, g = s.x.copy(), s.g.copy()
    for block in blocks:
        at = x[block.variables].tolist()
        change = _local_change(block, at, g[block.variables].tolist())
        if any(change):
            x[block.variables] = [a + d for a, d in zip(at, change, strict=True)]
            add_columns(block.variables, np.array(change), g)
    problem.counts["sweeps"] += 1
    d = x - s.x
    square = float(d @ d)
    curvature = float(d @ (g - s.g)) / square if square else 0.0
    return _State(problem.project(x), g, max(s.most, curvature))


def _local_change(block: _Block, x: Point, g: Point) -> Point:
    """Minimise gᵀd + ½dᵀAd over d with x + d in the set of the block; return d."""
    A, length, size = block.A, block.length, range(len(x))
    at, first = x, 0.0
    for _ in range(MAX_LOCAL):
        d = [a - b for a, b in zip(at, x, strict=True)]
        forces = [g[i] + sum(A[i][j] * d[j] for j in size) for i in size]
        after = block.project([at[i] - length * forces[i] for i in size])
        step = hypot(*(a - b for a, b in zip(after, at, strict=True)))
        at, first = after, first or step
        if step <= SETTLED * first:
            break
    return [a - b for a, b in zip(at, x, strict=True)]


def _on_interval(lower: float, upper: float, x: Point) -> Point:
    return [min(max(x[0], lower), upper)]


def _on_disc(radius: float, x: Point) -> Point:
    size = hypot(*x)
    return x if size <= radius else [radius / size * a for a in x]


def _on_cone(slope: float, x: Point) -> Point:
    normal, size = x[0], hypot(*x[1:])
    if size <= slope * normal:
        return x
    if slope * size <= -normal:
        return [0.0] * len(x)
    root = sqrt(1 + slope * slope)
    along = (normal + slope * size) / root
    factor = slope / root * along / size if size else 0.0
    return [along / root, *(factor * a for a in x[1:])]
