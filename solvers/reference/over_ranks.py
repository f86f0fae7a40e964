"""Reference solve of duals distributed over MPI ranks: active sets, CG on each face.

Minimises ½xᵀFx + qᵀx subject to Gx = e and l ≤ x ≤ u, with the components of x
distributed over the ranks (`harness.distributed`). The equality rows must be linearly
independent on the components without bounds, as they are if all bodies are supported.

1. On a face, with the components 𝒜 fixed at a bound, x_𝓕 solves a linear system:
   projected preconditioned conjugate gradients, 𝒫 = I − G_𝓕ᵀ(G_𝓕G_𝓕ᵀ)⁻¹G_𝓕, restarted
   from the true residual until only rounding remains (iterative refinement).
2. Primal-dual active sets (Hintermüller, Ito and Kunisch 2003, SIAM J. Optim. 13):
   components with a multiplier of the wrong sign are freed, components beyond a bound
   are fixed there. The sets may cycle. After ten changes in a row that did not reduce
   the number of wrong components, only the last wrong one changes, until there are
   fewer (block principal pivoting, Júdice and Pires 1994, Comput. Oper. Res. 21, which
   ends after finitely many changes).

The result is the solution, to about rounding, for the active set that both signs
confirm. It is computed without any of the solvers under test.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from sksparse.cholmod import CholmodNotPositiveDefiniteError, cholesky

from mortarbench.harness import QP, Solution, Status, Vector, kkt_residuals, no_rows
from mortarbench.harness.distributed.vectors import DistributedColumns, distributed

Mask = NDArray[np.bool_]

MAX_FACES = 300
#: changes of the active set, without fewer wrong components, before single exchanges
PATIENCE = 10
CG_REDUCTION = 1e-6  #: factor of the projected residual in each round of CG
MAX_CG_ROUNDS = 3  #: rounds of CG on a face
MAX_CG_STEPS = 300  #: steps of CG in a round
#: projected residual, relative to the projected q, that is not refined further
ROUNDING_RESIDUAL = 1e-14
#: Multipliers of the wrong sign and violations of bounds count as rounding below this
#: value, relative to the largest multiplier or component.
SIGN_ROUNDING = 1e-12
MAX_REFERENCE_RESIDUAL = 1e-9  #: largest KKT residual of a reference solution


def reference_over_ranks(qp: QP, start: Solution | None = None) -> Solution:
    """Solve a distributed dual to about rounding; collective over all ranks.

    qp : this rank's share of the dual
    start : solution of a dual that differs in its bounds only; its active set is tried
        first

    Raises
    ------
    ArithmeticError
        If no active set is confirmed within 300 faces, its point has a KKT residual
        above 1e-9, or the equality rows are linearly dependent on a face.

    """
    task = _Task.of(qp)
    point = task.zero_point() if start is None else _Point.of(start)
    fixed = (point.z != 0) | (task.lower == task.upper)
    # the nearer bound, not the sign of z: a multiplier near zero may have either sign
    below = point.x - task.lower <= task.upper - point.x
    lower, upper = fixed & below, fixed & ~below
    fewest, patience = np.inf, PATIENCE
    for faces in range(1, MAX_FACES + 1):
        point = task.minimise_on_face(point.x, lower, upper)
        below, above = task.next_active_set(point, lower, upper)
        wrong = (below != lower) | (above != upper)
        changes = task.total(float(np.count_nonzero(wrong)))
        if not changes:
            return _check_residual(qp, task, point, faces)
        patience = PATIENCE if changes < fewest else patience - 1
        fewest = min(fewest, changes)
        if patience < 0:
            wrong = task.only_last(wrong)
        lower, upper = np.where(wrong, below, lower), np.where(wrong, above, upper)
    raise ArithmeticError(
        f"the reference solve over ranks found no active set in {MAX_FACES} trials"
    )


def _check_residual(qp: QP, task: _Task, point: _Point, faces: int) -> Solution:
    s = Solution(
        status=Status.SOLVED,
        x=distributed(point.x, task.G.ranks),
        y=point.y,
        z=np.zeros(0),
        z_box=distributed(point.z, task.G.ranks),
        iterations=faces,
        counts={"P_products": task.products},
    )
    none = DistributedColumns(no_rows(point.x.size), task.G.ranks)
    worst = kkt_residuals(replace(qp, G=none), s).worst
    if not worst <= MAX_REFERENCE_RESIDUAL:
        raise ArithmeticError(
            f"the reference solve over ranks left a residual of {worst:.1e}, more than "
            f"{MAX_REFERENCE_RESIDUAL:g}"
        )
    return s


class _Point(NamedTuple):
    """Local components of a point, with the multipliers of Gx = e."""

    x: Vector  #: (n,)
    y: Vector  #: (r,) multipliers of Gx = e, on every rank
    z: Vector  #: (n,) multipliers of bounds; negative at a lower one

    @classmethod
    def of(cls, s: Solution) -> _Point:
        """Return the local components of a solution."""
        return cls(np.asarray(s.x), np.asarray(s.y), np.asarray(s.z_box))


@dataclass(eq=False)
class _Task:
    """Local part of a QP, in plain arrays."""

    F: Callable[[Vector], Vector]
    M: Callable[[Vector], Vector]  #: ≈ F⁻¹
    G: DistributedColumns
    e: Vector
    q: Vector
    lower: Vector
    upper: Vector
    products: int = 0

    @classmethod
    def of(cls, qp: QP) -> _Task:
        M = qp.P.preconditioner("dirichlet", "stiffness")
        q, lower, upper = (np.asarray(v) for v in (qp.q, qp.lb, qp.ub))
        return cls(
            lambda x: np.asarray(qp.P @ x),
            lambda x: np.asarray(M(x)),
            qp.A,
            np.asarray(qp.b),
            q,
            lower,
            upper,
        )

    def zero_point(self) -> _Point:
        zero = np.zeros(self.q.size)
        return _Point(zero, np.zeros(self.e.size), zero)

    def total(self, part: float) -> float:
        """Return the sum of a number over all ranks."""
        return float(self.G.ranks.total(np.array([part]))[0])

    def only_last(self, which: Mask) -> Mask:
        """Keep only the globally last True: the last one of the last rank with any."""
        ranks = self.G.ranks
        local = np.flatnonzero(which)
        last_rank = ranks.extreme(float(ranks.rank if local.size else -1), np.max)
        only = np.zeros_like(which)
        if ranks.rank == last_rank:
            only[local[-1]] = True
        return only

    def norm(self, v: Vector) -> float:
        return float(np.sqrt(self.total(float(v @ v))))

    def gradient(self, x: Vector) -> Vector:
        """Return Fx + q."""
        self.products += 1
        return self.F(x) + self.q

    def minimise_on_face(self, x: Vector, lower: Mask, upper: Mask) -> _Point:
        """Minimise on the face where the masked components are at their bounds.

        x : start
        """
        free = ~(lower | upper)
        try:
            coarse = cholesky(csc_matrix(self.G.gram(free)))
        except CholmodNotPositiveDefiniteError:
            raise ArithmeticError(
                "the reference solve over ranks reached a face with linearly dependent "
                "equality rows: with these contacts open, some body is not supported"
            ) from None

        def spread(t: Vector) -> Vector:
            """Return G_𝓕ᵀ(G_𝓕G_𝓕ᵀ)⁻¹t."""
            return np.where(free, np.asarray(self.G.T @ coarse(t)), 0.0)

        def project(v: Vector) -> Vector:
            v = np.where(free, v, 0.0)
            return v - spread(self.G @ v)

        x = np.where(lower, self.lower, np.where(upper, self.upper, x))
        x += spread(self.e - self.G @ x)
        size = self.norm(project(self.q))
        for _ in range(MAX_CG_ROUNDS):
            # the second projection removes the rounding of the first
            w = project(project(-self.gradient(x)))
            if self.norm(w) <= ROUNDING_RESIDUAL * size:
                break
            x += self._correction(w, project)
            x += spread(self.e - self.G @ x)
        r = -self.gradient(x)
        y = coarse(self.G @ np.where(free, r, 0.0))
        return _Point(x, y, np.where(free, 0.0, r - np.asarray(self.G.T @ y)))

    def _correction(self, w: Vector, project: Callable[[Vector], Vector]) -> Vector:
        """Return d in the face with 𝒫(w − Fd) small, by conjugate gradients."""
        d, enough = np.zeros(w.size), CG_REDUCTION * self.norm(w)
        p = y = project(self.M(w))
        wy = self.total(float(w @ y))
        for _ in range(MAX_CG_STEPS):
            Fp = self.F(p)
            self.products += 1
            curvature = self.total(float(p @ Fp))
            if not min(wy, curvature) > 0:  # only rounding along redundant rows is left
                break
            alpha = wy / curvature
            d += alpha * p
            w = w - alpha * project(Fp)
            if self.norm(w) <= enough:
                break
            y = project(self.M(w))
            wy, before = self.total(float(w @ y)), wy
            p = y + (wy / before) * p
        return d

    def next_active_set(
        self, point: _Point, lower: Mask, upper: Mask
    ) -> tuple[Mask, Mask]:
        """Return the masks of components to fix at lower and at upper bounds."""
        x, _, z = point
        largest = [
            self.G.ranks.extreme(float(abs(v).max(initial=0.0)), np.max) for v in (x, z)
        ]
        off_x, off_z = (SIGN_ROUNDING * v for v in largest)
        same = self.lower == self.upper
        below = np.where(lower, (z <= off_z) | same, x < self.lower - off_x)
        above = np.where(upper, z >= -off_z, x > self.upper + off_x)
        return below, above & ~below
