"""Interior-point method with CG preconditioned by multigrid and a contact filter.

The linear systems are those of the contact miniapp of MFEM (Petrides et al., AMG with
filtering: an efficient preconditioner for interior point methods in large-scale contact
mechanics optimization, arXiv:2505.18576, 2025). Inequality rows and finite bounds are
collected in Cx + s = d with s ≥ 0. All rows c of C and of A are divided by √(c D⁻¹cᵀ),
where D is the diagonal of P, with a typical curvature in place of negligible entries.
Fixed variables (lb = ub) have no rows in C; they keep their value. Each iteration takes
these steps:

1. Proximal method of multipliers (Rockafellar 1976; for interior points: Schwan, Jiang,
   Kuhn and Jones, PIQP, CDC 2023), with its centre at the current point. The Newton
   step then exists even if P is singular or rows are repeated:

       (P + δD)dx + Aᵀdy + Cᵀdz = −(Px + q + Aᵀy + Cᵀz)
       A dx − dy/κ              = b − Ax
       C dx + ds − dz/κ_C       = d − Cx − s
       z ds + s dz              = σμ − sz

2. Elimination of dy, ds and dz. The matrix of dx is

       H = P + δD + κAᵀA + CᵀWC,   W = (S Z⁻¹ + 1/κ_C)⁻¹.

3. Mehrotra's predictor (σ = 0), the centring σ = (μ_aff/μ)³, and the corrector.
4. Conjugate gradients for both right-hand sides. Near the solution, W is large at
   active rows and small at all others, and multigrid alone would fail. With the V-cycle
   B for H and the components F that occur in rows of A or G, the preconditioner is

       z ← H_FF⁻¹ r_F,   z ← z + B(r − Hz),   z ← z + H_FF⁻¹ (r − Hz)_F.

The V-cycle is smoothed aggregation of pyamg (Vaněk, Mandel and Brezina 1996, Computing
56). In the primal QP of floating elastic bodies, the kernel of P contains the
translations, which are its near-kernel vectors. Rotations are not used, because a QP
contains no coordinates.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import (
    bsr_array,
    csc_array,
    csr_array,
    csr_matrix,
    diags_array,
    eye_array,
    vstack,
)
from scipy.sparse.linalg import LinearOperator, cg
from sksparse.cholmod import CholmodNotPositiveDefiniteError, cholesky

from mortarbench.harness import (
    QP,
    About,
    Matrix,
    Solution,
    Status,
    Vector,
    needs_matrices,
)
from mortarbench.solvers.baselines.active_set import row_norms
from mortarbench.solvers.baselines.face import Mask
from mortarbench.solvers.common.conversion import check_positive
from mortarbench.solvers.common.stopping import curvatures, relative_residual

#: δ: weight of the proximal term of xᵢ, relative to Dᵢ
DELTA = 1e-9
#: κ: penalty of the scaled equality rows
KAPPA = 1e6
#: κ_C: largest weight W of a scaled inequality row
MAX_WEIGHT = 1e8
#: relative residual of conjugate gradients
CG_RTOL = 1e-4
#: conjugate gradients also end at a residual of this factor times tol·‖q‖; the error of
#: the step is a part of the next dual residual
CG_SHARE = 0.01
#: share of the distance to the boundary s = 0 or z = 0 that a step may cover
TO_BOUNDARY = 0.995
#: The method ends after this number of consecutive iterations, none of which halved the
#: smallest residual or the smallest sᵀz so far; rounding or inexact solves then prevent
#: progress.
PATIENCE = 10
#: a translation t counts as an element of the kernel if ‖Pt‖∞ is at most this factor
#: times ‖P‖∞
KERNEL_ROUNDING = 1e-8
#: largest number of unknowns on the coarsest level
COARSEST = 100
MAX_CG = 1000  #: largest number of CG steps per solve; contact cases need 5 to 80


class InnerSolveError(ArithmeticError):
    """Error for conjugate gradients that do not converge."""


class Point(NamedTuple):
    """Variables x, multipliers y and z of the scaled rows, and slacks s."""

    x: Vector
    y: Vector
    z: Vector
    s: Vector


@dataclass(frozen=True, eq=False)
class Problem:
    """A QP with scaled rows: min ½xᵀPx + qᵀx, Ax = b, Cx + s = d, s ≥ 0."""

    qp: QP
    P: csr_array
    D: Vector  #: (n,) diagonal of P; a typical curvature replaces negligible entries
    A: csr_array
    b: Vector
    A_norms: Vector  #: (m,) factors by which the rows of A were divided
    C: csr_array  #: (p, n) rows of G, then upper bounds, then lower bounds
    d: Vector
    C_norms: Vector  #: (p,) factors by which the rows of C were divided
    upper: NDArray[np.intp]  #: components with a finite upper bound
    lower: NDArray[np.intp]
    fixed: Mask  #: (n,) components with lb = ub, which have no rows in C
    filter: NDArray[np.intp]  #: components in rows of A or G that are not fixed
    V_cycle: Callable[[csr_array], LinearOperator]  #: sets up multigrid for a matrix

    def gradient(self, at: Point) -> Vector:
        """Return Px + q + Aᵀy + Cᵀz."""
        return np.asarray(self.P @ at.x + self.qp.q + self.A.T @ at.y + self.C.T @ at.z)

    def solution(self, at: Point) -> Solution:
        """Return the point with the multipliers of the original rows and bounds."""
        z, p = at.z / self.C_norms, self.qp.h.size
        z_box = np.zeros(at.x.size)
        z_box[self.upper] += z[p : p + self.upper.size]
        z_box[self.lower] -= z[p + self.upper.size :]
        z_box[self.fixed] = -self.gradient(at)[self.fixed]
        return Solution(
            status=Status.SOLVED,
            x=at.x,
            y=at.y / self.A_norms,
            z=z[:p],
            z_box=z_box,
        )


@dataclass(frozen=True)
class IPMAMG:
    """In-house interior-point method with filtered multigrid (AMG with filtering).

    P must be sparse. The iteration stops when the relative KKT residual of the QP is at
    most tol. The solver counts conjugate-gradient steps, and it counts each multigrid
    setup as a factorisation. It does not detect infeasible QPs.
    """

    max_iter: int = 100

    about: ClassVar[About] = About(
        title="Interior points with multigrid (ours)",
        licence="BSD-3-Clause",
        method="primal-dual interior point, in a proximal method of multipliers",
        linear_solver="conjugate gradients, preconditioned by smoothed aggregation "
        "(pyamg) and a Cholesky factor on the components of contact rows (CHOLMOD)",
        phases="scaling of the rows (preparing); multigrid setups and iterations "
        "(solving)",
        package="pyamg",
        limits=(
            "The near-kernel does not contain rotations, because a QP contains no "
            "coordinates.",
            "Infeasible and unbounded QPs are not detected: the solver ends at its "
            "limit of iterations, or it fails.",
        ),
    )

    def __post_init__(self) -> None:
        check_positive(max_iter=self.max_iter)

    def declines(self, qp: QP) -> str | None:
        if (reason := needs_matrices(qp)) is not None:
            return reason
        if isinstance(qp.P, np.ndarray):
            return "P is dense, but multigrid needs a sparse matrix"
        return None

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        problem = _scale(qp)

        def solve() -> Solution:
            counts = Counter[str]()
            try:
                solution = _iterate(problem, tol, self.max_iter, counts)
            except (InnerSolveError, CholmodNotPositiveDefiniteError) as e:
                solution = Solution.without_point(qp, Status.FAILED, f"{e}")
            name = {"linear_solver": "smoothed aggregation (pyamg)"}
            return replace(solution, counts=counts, reported=name)

        return solve


def _scale(qp: QP) -> Problem:
    """Collect and scale the rows."""
    P, A, G = csr_array(qp.P), csr_array(qp.A), csr_array(qp.G)
    D = curvatures(qp)
    fixed = qp.lb == qp.ub
    upper = np.flatnonzero(np.isfinite(qp.ub) & ~fixed)
    lower = np.flatnonzero(np.isfinite(qp.lb) & ~fixed)
    unit = csr_array(eye_array(qp.q.size))
    C = csr_array(vstack([G, unit[upper], -unit[lower]]))
    d = np.concatenate([qp.h, qp.ub[upper], -qp.lb[lower]])
    A_norms, C_norms = row_norms(A, D), row_norms(C, D)
    occurs = np.zeros(qp.q.size, dtype=bool)
    occurs[np.concatenate([A.indices, G.indices])] = True
    return Problem(
        qp=qp,
        P=P,
        D=D,
        A=csr_array(diags_array(1 / A_norms) @ A),
        b=qp.b / A_norms,
        A_norms=A_norms,
        C=csr_array(diags_array(1 / C_norms) @ C),
        d=d / C_norms,
        C_norms=C_norms,
        upper=upper,
        lower=lower,
        fixed=fixed,
        filter=np.flatnonzero(occurs & ~fixed),
        V_cycle=_multigrid(_near_kernel(P)),
    )


def _iterate(
    problem: Problem, tol: float, max_iter: int, counts: Counter[str]
) -> Solution:
    at = _start(problem, tol, counts)
    best, best_worst, least, stalled = problem.solution(at), np.inf, np.inf, 0
    for k in range(max_iter + 1):
        solution = replace(problem.solution(at), iterations=k, message="converged")
        worst = relative_residual(problem.qp, solution, tol)
        if worst <= tol:
            return solution
        total = float(at.s @ at.z)
        stalled = 0 if worst < best_worst / 2 or total < least / 2 else stalled + 1
        least = min(least, total)
        if worst < best_worst:
            best, best_worst = solution, worst
        if stalled >= PATIENCE:
            break
        at = _step(problem, at, tol, counts)
        if not all(np.isfinite(v).all() for v in at):
            break
    message = "step limit, or no further progress"
    return replace(best, status=Status.ITERATION_LIMIT, message=message)


def _start(problem: Problem, tol: float, counts: Counter[str]) -> Point:
    """Return Mehrotra's starting point.

    x minimises the objective plus ½‖Cx − d‖² and the penalty of Ax = b. The slacks
    d − Cx and the multipliers Cx − d are then shifted into the interior.
    """
    qp, (p, n) = problem.qp, problem.C.shape
    x = np.clip(np.zeros(n), qp.lb, qp.ub)
    at = Point(x, 0 * problem.b, np.zeros(p), np.zeros(p))
    solve = _solver(problem, np.ones(p), tol, counts)
    r = KAPPA * (problem.A.T @ (problem.b - problem.A @ x))
    x = x + solve(r + problem.C.T @ (problem.d - problem.C @ x) - problem.gradient(at))
    y = KAPPA * (problem.A @ x - problem.b)
    s = problem.d - problem.C @ x
    s, z = s + max(-1.5 * s.min(initial=0.0), 0), max(1.5 * s.max(initial=0.0), 0) - s
    if p and not s @ z > 0:  # every slack at x is zero
        unit = np.sqrt(np.abs(qp.q @ x)) or 1.0
        s, z = s + unit, z + unit
    if p:
        product = s @ z
        s, z = s + 0.5 * product / z.sum(), z + 0.5 * product / s.sum()
    return Point(x, y, z, s)


def _step(problem: Problem, at: Point, tol: float, counts: Counter[str]) -> Point:
    """Return the next point, see steps 1 to 3 of the module."""
    (x, _, z, s), A, C = at, problem.A, problem.C
    W = 1 / (s / z + 1 / MAX_WEIGHT)
    solve = _solver(problem, W, tol, counts)
    r_d, r_A, r_C = -problem.gradient(at), problem.b - A @ x, problem.d - C @ x - s

    def direction(product: Vector) -> Point:
        t = r_C - product / z
        dx = solve(r_d + KAPPA * (A.T @ r_A) + C.T @ (W * t))
        dz = W * (C @ dx - t)
        return Point(dx, KAPPA * (A @ dx - r_A), dz, (product - s * dz) / z)

    if not s.size:
        step = direction(s)
        return Point(*(v + dv for v, dv in zip(at, step, strict=True)))
    mu = s @ z / s.size
    affine = direction(-s * z)
    a = _length(at, affine)
    centring = ((s + a * affine.s) @ (z + a * affine.z) / (s @ z)) ** 3
    step = direction(centring * mu - s * z - affine.s * affine.z)
    a = min(1.0, TO_BOUNDARY * _length(at, step))
    return Point(*(v + a * dv for v, dv in zip(at, step, strict=True)))


def _length(at: Point, step: Point) -> float:
    """Return the largest a ≤ 1 with s + a·ds ≥ 0 and z + a·dz ≥ 0."""
    v, dv = np.concatenate([at.s, at.z]), np.concatenate([step.s, step.z])
    return float(min(1.0, (v[dv < 0] / -dv[dv < 0]).min(initial=1.0)))


def _solver(
    problem: Problem, W: Vector, tol: float, counts: Counter[str]
) -> Callable[[Vector], Vector]:
    """Set up the preconditioner of H; return r (n,) ↦ dx (n,), zero where fixed."""
    A, C, D, fixed, F = problem.A, problem.C, problem.D, problem.fixed, problem.filter
    H = problem.P + diags_array(DELTA * D) + KAPPA * (A.T @ A)
    H = H + C.T @ (diags_array(W) @ C)
    # fixed variables keep uncoupled rows, so that every node keeps its block
    mask = diags_array(1.0 * ~fixed)
    H = csr_array(mask @ H @ mask + diags_array(np.where(fixed, D, 0.0)))
    V_cycle = problem.V_cycle(H)
    counts["factorisations"] += 1
    if F.size:
        factor = cholesky(csc_array(H[F][:, F]))

    def filtered(r: Vector) -> Vector:
        if not F.size:
            return np.asarray(V_cycle @ r)
        z = np.zeros(r.size)
        z[F] = factor(r[F])
        z += V_cycle @ (r - H @ z)
        z[F] += factor((r - H @ z)[F])
        return z

    precondition = LinearOperator(H.shape, matvec=filtered, dtype=float)
    atol = CG_SHARE * tol * float(np.linalg.norm(problem.qp.q))

    def count(_: object) -> None:
        counts["cg"] += 1

    def solve(r: Vector) -> Vector:
        dx, failed = cg(
            H,
            np.where(fixed, 0.0, r),
            rtol=CG_RTOL,
            atol=atol,
            maxiter=MAX_CG,
            M=precondition,
            callback=count,
        )
        if failed:
            raise InnerSolveError(f"no convergence in {MAX_CG} steps of CG")
        return np.where(fixed, 0.0, dx)

    return solve


def _near_kernel(P: Matrix) -> NDArray[np.float64]:
    """Return translations (n, d) of nodes with d = 3 or 2 components, or ones (n, 1).

    Translations are returned if they are in the kernel of P, as for floating bodies.
    """
    n = P.shape[0]
    scale = KERNEL_ROUNDING * abs(P).sum(axis=1).max() if n else 0.0
    for d in (3, 2):
        if n and n % d == 0:
            kernel = np.tile(np.eye(d), (n // d, 1))
            if np.abs(P @ kernel).max() <= scale:
                return kernel
    return np.ones((n, 1))


def _multigrid(kernel: NDArray[np.float64]) -> Callable[[csr_array], LinearOperator]:
    """Return a function that sets up one V-cycle for a positive definite matrix (n, n).

    kernel : near-kernel vectors (n, d); matrices are divided into blocks of d rows

    Raises
    ------
    ImportError
        If pyamg is not installed.

    """
    import pyamg  # imported here because it is optional and slow to import

    d = kernel.shape[1]

    def V_cycle(M: csr_array) -> LinearOperator:
        levels = pyamg.smoothed_aggregation_solver(
            csr_matrix(M) if d == 1 else bsr_array(M, blocksize=(d, d)),
            B=kernel,
            symmetry="symmetric",
            max_coarse=COARSEST,
            coarse_solver="splu",  # the default pseudo-inverse took seconds
        )
        return levels.aspreconditioner()

    return V_cycle
