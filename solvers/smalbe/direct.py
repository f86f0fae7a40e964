"""SMALBE for small problems, with Cholesky factors of faces instead of iterations.

The method minimises ½xᵀPx + qᵀx subject to Gx = e and l ≤ x ≤ u by the proximal method
of multipliers (Rockafellar, Math. Oper. Res. 1, 1976, 97-116). Let C be orthonormal
rows that span the rows of G, x̃ the shortest vector with Gx̃ = e, and D the diagonal of
P. The following steps are repeated for k = 0, 1, …:

1. x ← argmin over the box of
   ½xᵀPx + qᵀx + aᵀC(x − x̃) + ρ/2 ‖C(x − x̃)‖² + δ/2 ‖x − x_k‖²_D,
   exactly, by an active-set method (`solvers.smalbe.faces`).
2. a ← a + ρC(x − x̃), x_{k+1} = x.

These steps are the outer loop of SMALBE (the paper's reference [3], Algorithm 6.1) with
exact inner solves, that is, with M = 0 in the stopping criterion ‖g^P‖ ≤ M‖C(x − x̃)‖.
Even if P is singular on a face, P + ρCᵀC + δD is positive definite because of the
proximal term. This term is zero at the solution, where x = x_k.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np

from mortarbench.harness import QP, About, Solution, Status, Vector
from mortarbench.solvers.common.conversion import check_positive, dense, needs_dense
from mortarbench.solvers.smalbe.compiled import relative_residuals
from mortarbench.solvers.smalbe.driver import MAX_IDLE_TIGHTENINGS
from mortarbench.solvers.smalbe.faces import Faces
from mortarbench.solvers.smalbe.infeasibility import infeasible
from mortarbench.solvers.smalbe.rows import FREE_RANK, DenseRows, orthonormal_rows

#: largest number of unknowns; because a factorisation costs O(n³), `smalbe` is often
#: faster even below this number
MAX_UNKNOWNS = 2000
INITIAL_RHO = 1e3  #: initial ρ/‖P‖ with the Frobenius norm
#: largest ρ/‖P‖, up to which ρ is increased if ‖C(x − x̃)‖ decreases slowly
MAX_RHO = 1e9
DELTA = 1e-10  #: weight δ of the proximal term


@dataclass(frozen=True)
class Direct:
    """In-house SMALBE for small problems, with updated Cholesky factors of faces.

    The loop ends when the relative KKT residual of the QP is at most tol. If the
    residual no longer decreases, the solver reports an iteration limit.
    """

    max_solves: int = 10_000  #: largest total number of solves with factors of faces

    about: ClassVar[About] = About(
        title="SMALBE, direct (ours)",
        licence="BSD-3-Clause",
        method="augmented Lagrangian with an exact inner active-set method",
        linear_solver="dense Cholesky factor, updated when the active set changes",
        phases="orthonormalisation of the equality rows and factorisation of the block "
        "of variables without bounds (preparing); iterations (solving)",
        limits=(
            "QPs with inequality rows are declined; dual forms have no inequality "
            "rows.",
            f"QPs with more than {MAX_UNKNOWNS} unknowns are declined. If P is sparse, "
            "`smalbe` is faster for more than 100 to 200 unknowns.",
        ),
    )

    def __post_init__(self) -> None:
        check_positive(max_solves=self.max_solves)

    def declines(self, qp: QP) -> str | None:
        if qp.h.size:
            return "accepts bounds and equality rows, but no inequality rows"
        if qp.q.size > MAX_UNKNOWNS:
            return f"accepts at most {MAX_UNKNOWNS} unknowns"
        return needs_dense(qp, 3)

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        P = qp.P if isinstance(qp.P, np.ndarray) else dense(qp.P)
        P = P if P.flags.c_contiguous else P.T  # P is symmetric
        rows = orthonormal_rows(qp.A, qp.b)
        if not rows.consistent:
            message = "the equality rows contradict each other"
            return partial(Solution.without_point, qp, Status.INFEASIBLE, message)
        bounds = (qp.lb, qp.ub)
        try:
            faces = Faces(P, qp.q, rows.C, rows.x_tilde, bounds, INITIAL_RHO, DELTA)
        except ArithmeticError:
            return partial(_not_convex, qp)
        return partial(_solved, _Task(qp, rows, faces), tol, self.max_solves)


class _Point(NamedTuple):
    x: Vector
    y: Vector
    z_box: Vector
    residual: float  #: relative KKT residual


@dataclass(frozen=True, eq=False)
class _Task:
    qp: QP
    rows: DenseRows
    faces: Faces

    def point(self, tol: float, *, fitted: bool) -> _Point:
        """Return the current x with its multipliers and its relative KKT residual.

        fitted : True to fit the multipliers a to the gradient on the free components by
            least squares. Without the fit, the rounding error of a is ρ times the
            rounding error of C(x − x̃), which may be too large.
        """
        qp, faces, a = self.qp, self.faces, self.faces.a
        x, Px, z_box = faces.at(a)
        if fitted:
            a = self._fitted(a, x, Px + qp.q)
            x, Px, z_box = faces.at(a)
        y = self.rows.multipliers(a)
        s = self.solution(x, y, z_box)
        worst = max(relative_residuals(qp, s, tol, Px, faces.diagonal, self.rows.G)[:2])
        return _Point(x, y, z_box, worst)

    def solution(self, x: Vector, y: Vector, z_box: Vector) -> Solution:
        """Return a point as a `Solution` with status SOLVED, not yet checked."""
        return Solution(
            status=Status.SOLVED,
            x=x,
            y=y,
            z=np.zeros(0),
            z_box=z_box,
            message="converged",
        )

    def _fitted(self, a: Vector, x: Vector, g: Vector) -> Vector:
        """Return the minimiser of ‖(g + Cᵀa)_F‖ on the free components F.

        If it is not unique, return the minimiser nearest to the argument `a`.
        """
        C, free = self.rows.C, (self.qp.lb < x) & (x < self.qp.ub)
        missing = g[free] + C.T[free] @ a
        change, _, rank, _ = np.linalg.lstsq(C.T[free], missing, rcond=FREE_RANK)
        if rank < len(C):
            return np.asarray(a - change)
        return np.asarray(np.linalg.lstsq(C.T[free], -g[free], rcond=FREE_RANK)[0])


def _solved(task: _Task, tol: float, most: int) -> Solution:
    """Run the outer loop until the residuals are within `tol` or stop decreasing."""
    qp, rows, faces = task.qp, task.rows, task.faces
    bounds = (qp.lb - rows.x_tilde, qp.ub - rows.x_tilde)
    best: _Point | None = None
    error, outer, waited, settled = np.inf, 0, 0, True
    most_rho = MAX_RHO / INITIAL_RHO * faces.rho
    while settled and waited < MAX_IDLE_TIGHTENINGS:
        outer += 1
        try:
            settled = faces.minimise(most)
        except ArithmeticError:
            return _not_convex(qp)
        before, error = error, faces.update()
        point = task.point(tol, fitted=waited > 0)
        gains = best is None or point.residual < best.residual / 2 or error < before / 2
        waited = 0 if gains else waited + 1
        if best is None or point.residual <= best.residual:
            best = point
        if point.residual <= tol:
            break
        if not gains and infeasible(rows, bounds, point.x - rows.x_tilde):
            message = "no point within the bounds satisfies the equality rows"
            return Solution.without_point(qp, Status.INFEASIBLE, message)
        if error > before / 10 and faces.rho < most_rho:
            most_rho = _penalised(faces, most_rho)
    message = "no further progress because of rounding, or the objective is unbounded"
    return _claimed(task, best, tol, message if settled else "step limit", outer)


def _penalised(faces: Faces, most: float) -> float:
    """Multiply ρ by 100 unless the factorisation fails; return the new limit on ρ."""
    rho = faces.rho
    try:
        faces.penalise(100 * rho)
    except ArithmeticError:
        faces.penalise(rho)
        return rho
    return most


def _claimed(
    task: _Task, point: _Point | None, tol: float, otherwise: str, outer: int
) -> Solution:
    """Return the final point, with status SOLVED if its KKT residual is ≤ tol.

    otherwise : message if the point is not a solution
    """
    faces = task.faces
    if point is None:
        return Solution.without_point(task.qp, Status.ITERATION_LIMIT, otherwise)
    s = task.solution(point.x, point.y, point.z_box)
    status, message = s.status, s.message
    if not point.residual <= tol:
        status, message = Status.ITERATION_LIMIT, otherwise
    counts = {
        "P_products": faces.products,
        "outer": outer,
        "solves": faces.solves,
        "set_changes": faces.joined + faces.left,
    }
    return replace(
        s, status=status, message=message, iterations=faces.solves, counts=counts
    )


def _not_convex(qp: QP) -> Solution:
    message = "P is not positive semidefinite"
    return Solution.without_point(qp, Status.FAILED, message)
