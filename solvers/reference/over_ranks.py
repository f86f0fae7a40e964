"""The reference solve of duals that ranks of MPI hold: active sets, CG on each face.

Minimises ½xᵀFx + qᵀx subject to Gx = e and l ≤ x ≤ u, where every rank has its own
components of x (`harness.distributed`) and equality rows are independent on components
without bounds, as they are where supports hold all bodies.

1. On a face, the components 𝒜 that are held at a bound, x_𝓕 solves a linear system:
   projected preconditioned conjugate gradients, 𝒫 = I − G_𝓕ᵀ(G_𝓕G_𝓕ᵀ)⁻¹G_𝓕, begun
   anew from the true residual until rounding is left (iterative refinement).
2. Primal-dual active sets (Hintermüller, Ito and Kunisch 2003, SIAM J. Optim. 13):
   what a multiplier of the wrong sign holds is freed, what is beyond a bound is held.
   They may come in circles. Where ten changes in a row have not lessened what is wrong,
   only the last wrong component is changed, until there is less (Júdice and Pires 1994,
   Comput. Oper. Res. 21: block principal pivoting, which ends after finitely many).

What comes out is the solution for the active set that both signs confirm, to about
rounding. Nothing of the solvers that are compared has a part in it.
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

MOST_FACES = 300  #: that are looked at
PATIENCE = 10  #: changes in a row that need not lessen what is wrong
WITHIN = 1e-6  #: of the projected residual, in each round of conjugate gradients
ROUNDS = 3  #: of these, at most
MOST_STEPS = 300  #: of conjugate gradients in a round
ENOUGH = 1e-14  #: projected residual relative to the data that is not refined any more
SIGNIFICANT = 1e-12  #: of the largest multiplier, or component: a wrong sign
ACCEPTED = 1e-9  #: KKT residual of what is called a solution


def reference_over_ranks(qp: QP, start: Solution | None = None) -> Solution:
    """Solve a share of a dual to about rounding; called by all ranks.

    start : solution of a dual with other bounds alone, whose active set is tried first

    Raises
    ------
    ArithmeticError
        When no active set is confirmed, its point has KKT residuals above 1e-9, or
        equality rows depend on each other on a face.

    """
    task = _Task.of(qp)
    point = task.at_rest() if start is None else _Point.of(start)
    held = (point.z != 0) | (task.lower == task.upper)
    below = point.x - task.lower <= task.upper - point.x  # a sign may be rounding
    lower, upper = held & below, held & ~below
    fewest, patience = np.inf, PATIENCE
    for faces in range(1, MOST_FACES + 1):
        point = task.on_face(point.x, lower, upper)
        below, above = task.wanted(point, lower, upper)
        wrong = (below != lower) | (above != upper)
        changes = task.total(float(np.count_nonzero(wrong)))
        if not changes:
            return _accepted(qp, task, point, faces)
        patience = PATIENCE if changes < fewest else patience - 1
        fewest = min(fewest, changes)
        if patience < 0:
            wrong = task.last(wrong)
        lower, upper = np.where(wrong, below, lower), np.where(wrong, above, upper)
    raise ArithmeticError(
        f"the reference solve over ranks found no active set in {MOST_FACES} trials"
    )


def _accepted(qp: QP, task: _Task, point: _Point, faces: int) -> Solution:
    s = Solution(
        status=Status.SOLVED, x=distributed(point.x, task.G.ranks), y=point.y,
        z=np.zeros(0), z_box=distributed(point.z, task.G.ranks), iterations=faces,
        counts={"P_products": task.products},
    )  # fmt: skip
    none = DistributedColumns(no_rows(point.x.size), task.G.ranks)
    worst = kkt_residuals(replace(qp, G=none), s).worst
    if not worst <= ACCEPTED:
        raise ArithmeticError(
            f"the reference solve over ranks left a residual of {worst:.1e}, more than "
            f"{ACCEPTED:g}"
        )
    return s


class _Point(NamedTuple):
    """Of this rank's components."""

    x: Vector  #: (n,)
    y: Vector  #: (r,) multipliers of Gx = e, on every rank
    z: Vector  #: (n,) multipliers of bounds; negative at a lower one

    @classmethod
    def of(cls, s: Solution) -> _Point:
        """Take this rank's part of a solution."""
        return cls(np.asarray(s.x), np.asarray(s.y), np.asarray(s.z_box))


@dataclass(eq=False)
class _Task:
    """A share of a QP, in plain arrays of this rank's components."""

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
            lambda x: np.asarray(qp.P @ x), lambda x: np.asarray(M(x)), qp.A,
            np.asarray(qp.b), q, lower, upper,
        )  # fmt: skip

    def at_rest(self) -> _Point:
        zero = np.zeros(self.q.size)
        return _Point(zero, np.zeros(self.e.size), zero)

    def total(self, part: float) -> float:
        """Add numbers over all ranks."""
        return float(self.G.ranks.total(np.array([part]))[0])

    def last(self, which: Mask) -> Mask:
        """Keep the last that is true: on the last rank that has any, elsewhere none."""
        ranks = self.G.ranks
        mine = np.flatnonzero(which)
        holder = ranks.extreme(float(ranks.rank if mine.size else -1), np.max)
        found = np.zeros_like(which)
        if ranks.rank == holder:
            found[mine[-1]] = True
        return found

    def norm(self, v: Vector) -> float:
        return float(np.sqrt(self.total(float(v @ v))))

    def gradient(self, x: Vector) -> Vector:
        """Return Fx + q."""
        self.products += 1
        return self.F(x) + self.q

    def on_face(self, x: Vector, lower: Mask, upper: Mask) -> _Point:
        """Minimise where the components of two masks are at their bounds.

        x : where to begin
        """
        free = ~(lower | upper)
        try:
            coarse = cholesky(csc_matrix(self.G.gram(free)))
        except CholmodNotPositiveDefiniteError:
            raise ArithmeticError(
                "the reference solve over ranks came to a face whose equations depend "
                "on each other: the open contacts leave some body without hold"
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
        for _ in range(ROUNDS):
            w = project(
                project(-self.gradient(x))
            )  # twice: the second removes rounding
            if self.norm(w) <= ENOUGH * size:
                break
            x += self._correction(w, project)
            x += spread(self.e - self.G @ x)
        r = -self.gradient(x)
        y = coarse(self.G @ np.where(free, r, 0.0))
        return _Point(x, y, np.where(free, 0.0, r - np.asarray(self.G.T @ y)))

    def _correction(self, w: Vector, project: Callable[[Vector], Vector]) -> Vector:
        """Return d in the face with 𝒫(w − Fd) small, by conjugate gradients."""
        d, enough = np.zeros(w.size), WITHIN * self.norm(w)
        p = y = project(self.M(w))
        wy = self.total(float(w @ y))
        for _ in range(MOST_STEPS):
            Fp = self.F(p)
            self.products += 1
            curvature = self.total(float(p @ Fp))
            if not min(wy, curvature) > 0:  # rounding in the kernel of redundant rows
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

    def wanted(self, point: _Point, lower: Mask, upper: Mask) -> tuple[Mask, Mask]:
        """Find what should be held at lower and at upper bounds."""
        x, _, z = point
        largest = [
            self.G.ranks.extreme(float(abs(v).max(initial=0.0)), np.max) for v in (x, z)
        ]
        off_x, off_z = (SIGNIFICANT * v for v in largest)
        same = self.lower == self.upper
        below = np.where(lower, (z <= off_z) | same, x < self.lower - off_x)
        above = np.where(upper, z >= -off_z, x > self.upper + off_x)
        return below, above & ~below
