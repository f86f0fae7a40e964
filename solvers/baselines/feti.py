"""FETI: projected preconditioned conjugate gradients for QPs with equality rows only.

The method minimises ½xᵀFx − dᵀx subject to Gx = e. If bodies are decomposed into
subdomains, the dual of a linear problem without contact has this form (Farhat and Roux
1991). Farhat, Mandel and Roux (1994) published the algorithm. With the projector P_Q =
I − QGᵀ(GQGᵀ)⁻¹G and a preconditioner M, its steps are:

1. x = QGᵀ(GQGᵀ)⁻¹e, r = d − Fx
2. w = P_Qᵀr; stop if ‖w‖ ≤ tol ‖w₀‖
3. y = P_Q M w
4. p = y − Σ pᵢ (yᵀFpᵢ)/(pᵢᵀFpᵢ) over all previous directions pᵢ
5. x ← x + αp, r ← r − αFp with α = pᵀw/pᵀFp; go to 2

Every Q that is positive definite on the range of Gᵀ is admissible. With Q = I, the
projector depends only on G. With Q = M (Klawonn and Widlund 2001), the number of steps
has a bound that does not depend on jumps of the stiffness within a body.
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
    too_large,
)
from mortarbench.harness.operators import Preconditioned, Product, SerialisableOperator
from mortarbench.solvers.common.conversion import (
    check_choice,
    check_positive,
    has_bound,
)
from mortarbench.solvers.common.stopping import relative_residual

Kind = Literal["auto", "none", "lumped", "dirichlet"]
Scaling = Literal["stiffness", "multiplicity"]
Weight = Literal["identity", "preconditioner"]
#: the solve fails if its reduced tolerance falls below this factor times tol
MIN_TOL_FACTOR = 1e-4
#: the solve fails after this number of consecutive steps if none of them halved the
#: smallest ‖w‖ so far
PATIENCE = 100
STAGNATED = (
    "no further progress because of rounding, or the objective is unbounded below"
)
#: for Q = I, rows count as dependent if the ratio of the smallest to the largest pivot
#: of GGᵀ is at most this value
MIN_PIVOT = 1e-13
BATCH = 256  #: number of columns of Gᵀ per application of the preconditioner


@dataclass(frozen=True)
class FETI:
    """In-house FETI: projected preconditioned CG that stores all directions.

    The iteration stops when the gradient Px + q, projected onto the kernel of the
    equality rows, is at most tol times its initial value and the relative KKT residual
    is at most tol. The solver reports the number of CG steps as iterations, and counts
    all products with the Hessian P.
    """

    #: preconditioner M; "auto" selects "dirichlet" if P provides it, otherwise "none"
    preconditioner: Kind = "auto"
    scaling: Scaling = "stiffness"  #: weights of the copies of an interface node in M
    Q: Weight = "identity"  #: matrix Q in the projector P_Q
    max_iter: int = 2000

    about: ClassVar[About] = About(
        title="FETI (ours)",
        licence="BSD-3-Clause",
        method="projected preconditioned conjugate gradients",
        linear_solver="products with P, and a Cholesky factor of the coarse problem",
        phases="factorisation of the coarse problem and setup of the preconditioner "
        "(preparing); iterations (solving)",
        limits=(
            "The solver declines QPs with bounds or inequality rows, because it "
            "solves linear problems only.",
            "The solver stores two vectors per iteration.",
        ),
    )

    def __post_init__(self) -> None:
        check_positive(max_iter=self.max_iter)
        check_choice("preconditioner", self.preconditioner, get_args(Kind))
        check_choice("scaling", self.scaling, get_args(Scaling))
        check_choice("Q", self.Q, get_args(Weight))

    def declines(self, qp: QP) -> str | None:
        if qp.h.size or has_bound(qp).any():
            return "accepts equality rows only, because it solves linear problems"
        if preconditioner_source(qp) is None:
            if self.preconditioner in ("lumped", "dirichlet"):
                return f"P does not provide the preconditioner {self.preconditioner!r}"
            if self.Q == "preconditioner":
                return "Q = 'preconditioner' needs a P that provides a preconditioner"
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
            message = "the equality rows are linearly dependent"
            return lambda: Solution.without_point(qp, Status.FAILED, message)
        return lambda: _solve(_Task(qp, coarse, apply, counts), tol, self.max_iter)

    def _preconditioner(self, qp: QP) -> Product | None:
        """Return the preconditioner x ↦ Mx, or None for M = I."""
        operator = preconditioner_source(qp)
        if operator is None or self.preconditioner == "none":
            return None
        kind = "dirichlet" if self.preconditioner == "auto" else self.preconditioner
        return operator.preconditioner(kind, self.scaling)


def preconditioner_source(qp: QP) -> Preconditioned | None:
    """Return P as an operator that provides preconditioners, or None."""
    if not isinstance(qp.P, SerialisableOperator):
        return None
    product = qp.P.build()
    return product if isinstance(product, Preconditioned) else None


@dataclass(frozen=True, eq=False)
class _Coarse:
    """Projector P_Q, with a factor of the coarse matrix GQGᵀ."""

    G: csr_array  #: (r, m)
    QGT: Any  #: QGᵀ (m, r), sparse or dense
    solve: Callable[[Vector], Vector]  #: t ↦ (GQGᵀ)⁻¹t

    def feasible(self, e: Vector) -> Vector:
        """Return the solution x of Gx = e in the range of QGᵀ."""
        return np.asarray(self.QGT @ self.solve(e))

    def project(self, v: Vector) -> Vector:
        """Return P_Q v."""
        return np.asarray(v - self.QGT @ self.solve(self.G @ v))

    def multipliers(self, r: Vector) -> Vector:
        """Return the multipliers y (r,) with Gᵀy = r − P_Qᵀr."""
        return self.solve(self.QGT.T @ r)


def _coarse(qp: QP, Q: Product | None) -> _Coarse:
    G = csr_array(qp.A)
    if not G.shape[0]:
        return _Coarse(G, csr_array(G.T), lambda t: t)
    if Q is None:
        factor = cholesky(csc_matrix(G @ G.T))
        pivots = factor.D()
        if pivots.min() <= MIN_PIVOT * pivots.max():
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
    """F-orthonormal directions p of all steps, and the products Fp, stored as rows."""

    P: NDArray[np.float64]
    FP: NDArray[np.float64]
    count: int = 0

    def add(self, p: Vector, Fp: Vector) -> None:
        """Append a direction p and Fp; double the arrays if they are full."""
        if self.count == len(self.P):
            self.P, self.FP = (
                np.vstack([M, np.empty_like(M)]) for M in (self.P, self.FP)
            )
        self.P[self.count], self.FP[self.count] = p, Fp
        self.count += 1

    def conjugate(self, y: Vector) -> Vector:
        """Return the component of y that is F-orthogonal to all directions."""
        P, FP = self.P[: self.count], self.FP[: self.count]
        return np.asarray(y - P.T @ (FP @ y))


def _solve(task: _Task, tol: float, max_iter: int) -> Solution:
    """Reduce the bound on ‖w‖ until the relative KKT residual is at most tol."""
    qp, tighter = task.qp, 1.0
    at = _state(task, task.coarse.feasible(qp.b))
    directions = _Directions(np.empty((16, qp.q.size)), np.empty((16, qp.q.size)))
    norms = [float(np.linalg.norm(at.w))]
    while True:
        at, reason = _iterate(task, at, directions, norms, tighter * tol, max_iter)
        at = _state(task, at.x)
        norms[-1] = float(np.linalg.norm(at.w))
        task.counts.setdefault("steps_to_tol", len(norms) - 1)
        point = _point(task, at, norms)
        worst = relative_residual(qp, point, tol)
        if worst <= tol:
            return point
        tighter *= min(0.5, max(0.1, tol / worst))
        if reason or tighter < MIN_TOL_FACTOR or not np.isfinite(worst):
            return replace(
                point, status=Status.ITERATION_LIMIT, message=reason or STAGNATED
            )


def _iterate(
    task: _Task,
    at: _State,
    directions: _Directions,
    norms: list[float],
    accuracy: float,
    max_iter: int,
) -> tuple[_State, str]:
    """Iterate until ‖w‖ ≤ accuracy·‖w₀‖; return the state and the reason for a failure.

    The reason is empty if the iteration did not fail.
    """
    least, stalled = norms[-1], 0
    while norms[-1] > accuracy * norms[0]:
        if directions.count >= max_iter:
            return at, "step limit"
        step = _step(task, at, directions)
        if step is None or stalled == PATIENCE:
            return at, STAGNATED
        at = step
        norms.append(float(np.linalg.norm(at.w)))
        stalled = 0 if norms[-1] < least / 2 else stalled + 1
        least = min(least, norms[-1])
    return at, ""


def _state(task: _Task, x: Vector) -> _State:
    """Return the state at x, with w recomputed from F and d."""
    # project twice: a large y causes rounding errors in the first projection, and the
    # second projection removes these errors
    once = _project(task, x, np.zeros(task.qp.b.size), -task.qp.q - task.product(x))
    return _project(task, *once)


def _project(task: _Task, x: Vector, y: Vector, r: Vector) -> _State:
    """Return the state with r projected and y increased by the multipliers."""
    change = task.coarse.multipliers(r)
    return _State(x, y + change, np.asarray(r - task.qp.A.T @ change))


def _step(task: _Task, at: _State, directions: _Directions) -> _State | None:
    """Return the next state, or None if the new direction has a curvature ≤ 0."""
    p = directions.conjugate(task.preconditioned(at.w))
    Fp = task.product(p)
    curvature = float(p @ Fp)
    if not curvature > 0:
        return None
    size = np.sqrt(curvature)
    p, Fp = p / size, Fp / size
    directions.add(p, Fp)
    alpha = float(p @ at.w)
    return _project(task, at.x + alpha * p, at.y, at.w - alpha * Fp)


def _point(task: _Task, at: _State, norms: list[float]) -> Solution:
    n, m = task.qp.q.size, len(norms)
    # the evaluation of the KKT residual by the caller takes one product
    task.counts["P_products"] += 1
    return Solution(
        status=Status.SOLVED,
        x=at.x,
        y=at.y,
        z=np.zeros(0),
        z_box=np.zeros(n),
        iterations=m - 1,
        message="converged",
        counts=dict(task.counts),
        history={"step": np.full(m, "c"), "free_gradient": np.array(norms)},
    )
