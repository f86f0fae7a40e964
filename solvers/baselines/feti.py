"""FETI: projected preconditioned conjugate gradients for equality rows only.

Minimises ½xᵀFx − dᵀx subject to Gx = e, which for a dual of torn bodies is the linear
problem without contact (Farhat and Roux 1991; Farhat, Mandel and Roux 1994, from where
the steps are). With P_Q = I − QGᵀ(GQGᵀ)⁻¹G and a preconditioner M:

1. x = QGᵀ(GQGᵀ)⁻¹e, r = d − Fx
2. w = P_Qᵀr; done where ‖w‖ ≤ tol ‖w₀‖
3. y = P_Q M w
4. p = y − Σ pᵢ (yᵀFpᵢ)/(pᵢᵀFpᵢ) over all directions so far
5. x ← x + αp, r ← r − αFp, α = pᵀw/pᵀFp; back to 2

Any Q that is positive definite on Gᵀ serves. Q = I needs no more than G; Q = M
(Klawonn and Widlund 2001) is what keeps the count where stiffnesses jump inside a body.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csc_matrix, csr_array
from sksparse.cholmod import CholmodNotPositiveDefiniteError, cholesky

from mortarbench.harness import (
    QP,
    About,
    Solution,
    Status,
    Vector,
    kkt_residuals,
    too_large,
)
from mortarbench.harness.operators import Preconditioned, Product, SerialisableOperator
from mortarbench.solvers.common.conversion import boxed, one_of, positive

Kind = Literal["auto", "none", "lumped", "dirichlet"]
Scaling = Literal["stiffness", "multiplicity"]
Weight = Literal["identity", "preconditioner"]
CLAIM = 5.0  #: claimed solved: the KKT residuals are within this times the tolerance
TIGHTEST = 1e-4  #: factor of the tolerance at which they have had their chance
PATIENCE = 100  #: steps in a row that need not halve ‖w‖
LEFT = "no further progress: rounding, or the cost is unbounded"
PIVOT = 1e-13  #: of the factor of GQGᵀ, relative to the largest: rows are dependent
BATCH = 256  #: columns of Gᵀ that the preconditioner is applied to at a time


@dataclass(frozen=True)
class FETI:
    """In-house FETI: projected preconditioned CG, all directions kept.

    `tol` bounds ‖P_Qᵀ(d − Fx)‖ relative to its first value, less where the KKT
    residuals on the QP are not within 5·tol then; no other point is claimed solved.
    Iterations are CG steps; all products with P are counted.
    """

    preconditioner: Kind = "auto"  #: Dirichlet's where P offers it, else none
    scaling: Scaling = "stiffness"  #: of the preconditioner where subdomains meet
    Q: Weight = "identity"  #: of the projector
    max_iter: int = 2000

    about: ClassVar[About] = About(
        title="FETI (ours)", licence="BSD-3-Clause",
        method="projected preconditioned conjugate gradients",
        linear_solver="products with P; a Cholesky factor of the coarse problem",
        phases="preparing factorises the coarse problem and sets up the preconditioner",
        limits=(
            "for linear problems: bounds and inequality rows are declined",
            "keeps two vectors per iteration",
        ),
    )  # fmt: skip

    def __post_init__(self) -> None:
        positive(max_iter=self.max_iter)
        one_of("preconditioner", self.preconditioner, get_args(Kind))
        one_of("scaling", self.scaling, get_args(Scaling))
        one_of("Q", self.Q, get_args(Weight))

    def declines(self, qp: QP) -> str | None:
        if qp.h.size or boxed(qp).any():
            return "takes equality rows only: it solves linear problems"
        if offered(qp) is None:
            if self.preconditioner in ("lumped", "dirichlet"):
                return f"P offers no preconditioner {self.preconditioner!r}"
            if self.Q == "preconditioner":
                return "Q = 'preconditioner' needs a P that offers one"
        elif self.Q == "preconditioner":
            if self.preconditioner == "none":
                return "Q = 'preconditioner' needs a preconditioner other than 'none'"
            return too_large(qp.q.size, 2 * qp.b.size / max(qp.q.size, 1))
        return None

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        counts: Counter[str] = Counter()
        apply = self._preconditioner(qp)
        try:
            coarse = _coarse(qp, apply if self.Q == "preconditioner" else None)
        except (CholmodNotPositiveDefiniteError, np.linalg.LinAlgError):
            message = "the equality rows depend on each other"
            return lambda: Solution.without_point(qp, Status.FAILED, message)
        return lambda: _certified(_Task(qp, coarse, apply, counts), tol, self.max_iter)

    def _preconditioner(self, qp: QP) -> Product | None:
        """Make x ↦ Mx; None for M = I."""
        operator = offered(qp)
        if operator is None or self.preconditioner == "none":
            return None
        kind = "dirichlet" if self.preconditioner == "auto" else self.preconditioner
        return operator.preconditioner(kind, self.scaling)


def offered(qp: QP) -> Preconditioned | None:
    """Give what P offers preconditioners by, if it does."""
    if not isinstance(qp.P, SerialisableOperator):
        return None
    product = qp.P.build()
    return product if isinstance(product, Preconditioned) else None


@dataclass(frozen=True, eq=False)
class _Coarse:
    """The projector P_Q and its coarse problem GQGᵀ."""

    G: csr_array  #: (r, m)
    QGT: Any  #: QGᵀ (m, r), sparse or dense
    solve: Callable[[Vector], Vector]  #: (GQGᵀ)⁻¹

    def feasible(self, e: Vector) -> Vector:
        """Return the x with Gx = e in the span of QGᵀ."""
        return np.asarray(self.QGT @ self.solve(e))

    def project(self, v: Vector) -> Vector:
        """Apply P_Q."""
        return np.asarray(v - self.QGT @ self.solve(self.G @ v))

    def multipliers(self, r: Vector) -> Vector:
        """Return the y for which Gᵀy is r less P_Qᵀr."""
        return self.solve(self.QGT.T @ r)


def _coarse(qp: QP, Q: Product | None) -> _Coarse:
    G = csr_array(qp.A)
    if not G.shape[0]:
        return _Coarse(G, csr_array(G.T), lambda t: t)
    if Q is None:
        factor = cholesky(csc_matrix(G @ G.T))
        pivots = factor.D()
        if pivots.min() <= PIVOT * pivots.max():
            raise np.linalg.LinAlgError
        return _Coarse(G, csr_array(G.T), lambda t: np.asarray(factor(t)))
    QGT = np.empty((G.shape[1], G.shape[0]))
    for begin in range(0, G.shape[0], BATCH):
        rows = slice(begin, begin + BATCH)
        QGT[:, rows] = Q(np.ascontiguousarray(G[rows].toarray().T))
    dense = cho_factor(G @ QGT)
    return _Coarse(G, QGT, lambda t: np.asarray(cho_solve(dense, t)))


@dataclass(frozen=True, eq=False)
class _Task:
    qp: QP
    coarse: _Coarse
    apply: Product | None
    counts: Counter[str]

    def product(self, v: Vector) -> Vector:
        self.counts["P_products"] += 1
        return np.asarray(self.qp.P @ v)

    def preconditioned(self, w: Vector) -> Vector:
        """Return P_Q M w."""
        if self.apply is not None:
            self.counts["preconditioner_applies"] += 1
            w = self.apply(w)
        return self.coarse.project(w)


class _State(NamedTuple):
    x: Vector
    y: Vector  #: (r,) multipliers of Gx = e
    w: Vector  #: d − Fx − Gᵀy = P_Qᵀ(d − Fx)


@dataclass(eq=False)
class _Directions:
    """All directions p so far with their products, F-orthonormal, row by row."""

    P: NDArray[np.float64]
    FP: NDArray[np.float64]
    count: int = 0

    def add(self, p: Vector, Fp: Vector) -> None:
        """Append one; the room is doubled where it is full."""
        if self.count == len(self.P):
            self.P, self.FP = (
                np.vstack([M, np.empty_like(M)]) for M in (self.P, self.FP)
            )
        self.P[self.count], self.FP[self.count] = p, Fp
        self.count += 1

    def conjugate(self, y: Vector) -> Vector:
        """Make y F-orthogonal to all."""
        P, FP = self.P[: self.count], self.FP[: self.count]
        return np.asarray(y - P.T @ (FP @ y))


def _certified(task: _Task, tol: float, most: int) -> Solution:
    """Tighten the tolerance until the KKT residuals agree."""
    qp, tighter = task.qp, 1.0
    at = _state(task, task.coarse.feasible(qp.b))
    directions = _Directions(np.empty((16, qp.q.size)), np.empty((16, qp.q.size)))
    norms = [float(np.linalg.norm(at.w))]
    while True:
        at, ended = _iterated(task, at, directions, norms, tighter * tol, most)
        at = _state(task, at.x)
        norms[-1] = float(np.linalg.norm(at.w))
        task.counts.setdefault("steps_to_tol", len(norms) - 1)
        point = _point(task, at, norms)
        worst = kkt_residuals(qp, point).worst
        if worst <= CLAIM * tol:
            return point
        tighter *= min(0.5, max(0.1, CLAIM * tol / worst))
        if ended or tighter < TIGHTEST or not np.isfinite(worst):
            return replace(point, status=Status.ITERATION_LIMIT, message=ended or LEFT)


def _iterated(
    task: _Task, at: _State, directions: _Directions, norms: list[float],
    accuracy: float, most: int,
) -> tuple[_State, str]:  # fmt: skip
    """Move until ‖w‖ ≤ accuracy ‖w₀‖; say why it ended before, if it did."""
    least, waited = norms[-1], 0
    while norms[-1] > accuracy * norms[0]:
        if directions.count >= most:
            return at, "step limit"
        step = _step(task, at, directions)
        if step is None or waited == PATIENCE:
            return at, LEFT
        at = step
        norms.append(float(np.linalg.norm(at.w)))
        waited = 0 if norms[-1] < least / 2 else waited + 1
        least = min(least, norms[-1])
    return at, ""


def _state(task: _Task, x: Vector) -> _State:
    """Compute the residual anew; it is projected twice, for y may be large."""
    once = _projected(task, x, np.zeros(task.qp.b.size), -task.qp.q - task.product(x))
    return _projected(task, *once)


def _projected(task: _Task, x: Vector, y: Vector, r: Vector) -> _State:
    """Project the residual r of x and y by multipliers, which are added to y."""
    change = task.coarse.multipliers(r)
    return _State(x, y + change, np.asarray(r - task.qp.A.T @ change))


def _step(task: _Task, at: _State, directions: _Directions) -> _State | None:
    """Move once; None where there is no curvature along the direction."""
    p = directions.conjugate(task.preconditioned(at.w))
    Fp = task.product(p)
    curvature = float(p @ Fp)
    if not curvature > 0:
        return None
    size = np.sqrt(curvature)
    p, Fp = p / size, Fp / size
    directions.add(p, Fp)
    alpha = float(p @ at.w)
    return _projected(task, at.x + alpha * p, at.y, at.w - alpha * Fp)


def _point(task: _Task, at: _State, norms: list[float]) -> Solution:
    n, m = task.qp.q.size, len(norms)
    task.counts["P_products"] += 1  # of the residuals that follow
    return Solution(
        status=Status.SOLVED, x=at.x, y=at.y, z=np.zeros(0),
        z_box=np.zeros(n), iterations=m - 1, message="converged",
        counts=dict(task.counts),
        history={"step": np.full(m, "c"), "free_gradient": np.array(norms)},
    )  # fmt: skip
